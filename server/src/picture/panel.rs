//! A panel of a figure: the surface of cut tissue or a cross-section, with lines and dots over it.

use std::collections::{BTreeSet, HashMap, HashSet};

use palpate_tissue::{FaceId, Model, Shape, Topology, Vec3};

use super::Slice;
use super::colour::{self, Colour};
use super::section::{MM, Point, Section};
use super::view::{SeenFace, View, seen};
use crate::cut::walls::wall_faces;

/// A filled shape with the lines around it.
pub(super) struct Piece {
    pub(super) fills: Vec<Vec<Point>>,
    pub(super) colour: Colour,
    pub(super) edges: Vec<([Point; 2], Edge)>,
}

/// The kind of an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Edge {
    /// Between faces of one surface.
    Mesh,
    /// Between regions.
    Border,
    /// Between the outer surface and the wall of a wound.
    Lip,
}

/// A panel of a [`figure`](super::figure()).
pub struct Panel {
    pub(super) title: String,
    pub(super) pieces: Vec<Piece>,
    pub(super) lines: Vec<[Point; 2]>,
    pub(super) dots: Vec<Point>,
    /// Lower and upper corner in mm.
    pub(super) bounds: [Point; 2],
    pub(super) regions: BTreeSet<usize>,
    view: View,
}

impl Panel {
    fn new(title: &str, view: View) -> Self {
        Self {
            title: title.to_owned(),
            pieces: Vec::new(),
            lines: Vec::new(),
            dots: Vec::new(),
            bounds: [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]],
            regions: BTreeSet::new(),
            view,
        }
    }

    /// The visible faces of a surface. Walls of wounds are its faces with a cell next to them on the lattice; they have the
    /// colour of their tissue.
    pub fn surface(
        title: &str,
        topology: &Topology,
        shape: &Shape,
        view: View,
        is_shown: impl Fn(&FaceId, &Vec3) -> bool,
    ) -> Self {
        let mut panel = Self::new(title, view);
        let colours = colour::of_regions(topology.model());
        let walls: HashSet<FaceId> = wall_faces(topology).into_iter().collect();
        let faces = topology.boundary().faces.iter();
        let faces: Vec<SeenFace> = faces
            .map(|&face| SeenFace::of(topology, shape, face))
            .collect();
        let mut at_wall = HashSet::new();
        let mut outer = HashSet::new();
        let mut region_at = HashMap::new();
        let mut borders = HashSet::new();
        for face in &faces {
            let is_wall = walls.contains(&face.face);
            let region = topology.region(face.face.cell());
            for edge in edges(face) {
                if is_wall {
                    at_wall.insert(edge);
                } else {
                    outer.insert(edge);
                }
                if *region_at.entry(edge).or_insert(region) != region {
                    borders.insert(edge);
                }
            }
        }
        let shown = faces.into_iter().filter(|f| is_shown(&f.face, &f.centre()));
        for face in seen(shown, &view) {
            let region = topology.region(face.face.cell());
            let corners = face.corners.map(|p| view.flat(&p));
            let [a, b, c, d] = corners;
            let kind = |edge: &[u32; 2]| {
                if at_wall.contains(edge) && outer.contains(edge) {
                    Edge::Lip
                } else if borders.contains(edge) {
                    Edge::Border
                } else {
                    Edge::Mesh
                }
            };
            let kinds = edges(&face).map(|edge| kind(&edge));
            let light = view.brightness(&face.area);
            panel.add(Piece {
                fills: vec![vec![a, b, c], vec![a, c, d]],
                colour: colours[region.index()].map(|v| (f64::from(v) * light) as u8),
                edges: [[a, b], [b, c], [c, d], [d, a]]
                    .into_iter()
                    .zip(kinds)
                    .collect(),
            });
            panel.regions.insert(region.index());
        }
        panel
    }

    /// The cross-section normal to an axis.
    pub fn slice(title: &str, model: &Model, axis: usize, at_m: f64) -> Result<Self, String> {
        let at_mm = Some(at_m * MM);
        let section = Section::through(model, Slice { axis, at_mm })?;
        let mut panel = Self::new(title, View::along(axis));
        let colours = colour::of_regions(model);
        for cell in section.cells {
            let edges = cell.outline.into_iter().map(|(line, is_border)| {
                let kind = if is_border { Edge::Border } else { Edge::Mesh };
                (line, kind)
            });
            panel.regions.insert(cell.region);
            panel.add(Piece {
                fills: cell.pieces,
                colour: colours[cell.region],
                edges: edges.collect(),
            });
        }
        Ok(panel)
    }

    fn add(&mut self, piece: Piece) {
        for p in piece.fills.iter().flatten() {
            for a in 0..2 {
                self.bounds[0][a] = self.bounds[0][a].min(p[a]);
                self.bounds[1][a] = self.bounds[1][a].max(p[a]);
            }
        }
        self.pieces.push(piece);
    }

    /// With a line through points over it, such as the path of a blade.
    #[must_use]
    pub fn with_line(mut self, points: &[Vec3]) -> Self {
        let flat = |p: &Vec3| self.view.flat(p);
        let lines = points.windows(2).map(|w| [flat(&w[0]), flat(&w[1])]);
        self.lines.extend(lines.collect::<Vec<_>>());
        self
    }

    /// With dots over it.
    #[must_use]
    pub fn with_dots(mut self, points: &[Vec3]) -> Self {
        let view = self.view;
        self.dots.extend(points.iter().map(|p| view.flat(p)));
        self
    }
}

/// The edges of a face, as pairs of nodes.
fn edges(face: &SeenFace) -> [[u32; 2]; 4] {
    let [a, b, c, d] = face.nodes;
    [[a, b], [b, c], [c, d], [d, a]].map(|[a, b]| [a.min(b), a.max(b)])
}

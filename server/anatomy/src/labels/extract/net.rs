//! The mesh that all regions share: a vertex per corner between voxels of different regions (at pinched
//! edges one per side), a quadrilateral per face between two of them.

use std::path::Path;

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::fans::{self, face};
use super::voxel_grid::{BEYOND, Grid, OUTSIDE};
use crate::InputError;
use crate::labels::Affine;

/// No vertex in this direction.
pub(super) const NONE: u32 = u32::MAX;

/// Most vertices of one net. Reason: they give twice as many triangles, the limit of a surface file, at some
/// 200 bytes each with all derived data. Beyond the bound the volume is rejected.
pub const NET_VERTICES_MAX: usize = 10_000_000;

/// Position of a vertex and its surroundings.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corner {
    /// The corner between voxels `at - 1` and `at` along each axis.
    pub(super) at: [u32; 3],
    /// Regions of the eight voxels, bit a of the index: the further one along axis a.
    pub(super) block: [u8; 8],
    /// Neighbours along -x, +x, -y, +y, -z, +z, or [`NONE`] where no boundary runs.
    pub(super) neighbours: [u32; 6],
    /// Bit d: the vertex may slide towards neighbour d.
    pub(super) follows: u8,
    /// Whether these are neighbours along a line where three regions meet.
    pub(super) on_line: bool,
    /// Bit a: the vertex lies in the volume's border across axis a and stays there.
    pub(super) locked: u8,
    /// The faces around it, as bits: all faces of the corner, except at a pinched layer, where each side has
    /// its own vertex.
    pub(super) faces: u16,
    /// Bit d: the edge in direction d is pinched.
    pub(super) pinched: u8,
    /// The direction of its own side, if other vertices share the corner.
    pub(super) aside: Option<Vec3>,
}

/// A face between a voxel and the next one along `axis`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quad {
    /// Vertices, counter-clockwise seen from the further voxel, beginning with the lowest.
    pub(super) corners: [u32; 4],
    pub(super) axis: u8,
    /// Regions of the two voxels; voxels beyond the border are outside.
    pub(super) sides: [u8; 2],
    /// Whether the diagonal runs from corner 1 to 3 instead of 0 to 2.
    pub(super) turned: bool,
}

impl Quad {
    /// The two triangles, as indices of the corners.
    pub(super) fn triangles(&self) -> [[usize; 3]; 2] {
        if self.turned {
            [[1, 2, 3], [1, 3, 0]]
        } else {
            [[0, 1, 2], [0, 2, 3]]
        }
    }
}

/// The shared mesh.
pub(super) struct Net {
    pub(super) corners: Vec<Corner>,
    /// Displacement of each vertex from its corner, in voxels.
    pub(super) moved: Vec<Vec3>,
    pub(super) quads: Vec<Quad>,
    pub(super) to_world: Affine,
}

/// A region on one side of a boundary.
fn solid(region: u8) -> u8 {
    if region == BEYOND { OUTSIDE } else { region }
}

fn mixed(block: &[u8]) -> bool {
    block.iter().any(|r| solid(*r) != solid(block[0]))
}

impl Net {
    pub(super) fn of(grid: &Grid, path: &Path) -> Result<Self, InputError> {
        let layers = grid.size[2] - 1;
        let count: usize = (1..=layers)
            .into_par_iter()
            .map(|z| Blocks::new(grid, z).filter(|(_, b)| mixed(b)).count())
            .sum();
        if count > NET_VERTICES_MAX {
            let what = format!(
                "the regions meet at {count} corners of voxels, the limit is {NET_VERTICES_MAX}; crop or resample \
                 the volume (is it a segmentation, and not noise?)"
            );
            return Err(InputError::of(path, what));
        }
        let by_layer: Vec<Vec<Corner>> = (1..=layers)
            .into_par_iter()
            .map(|z| {
                Blocks::new(grid, z)
                    .filter(|(_, block)| mixed(block))
                    .flat_map(|(at, block)| Corner::all(at, block))
                    .collect()
            })
            .collect();
        let corners = joined(grid, &by_layer);
        let quads = corners
            .par_iter()
            .enumerate()
            .flat_map_iter(|(v, corner)| quads_from(&corners, v as u32, corner))
            .collect();
        Ok(Self {
            moved: vec![Vec3::zeros(); corners.len()],
            corners,
            quads,
            to_world: grid.to_world,
        })
    }

    /// Position of a vertex in voxel indices.
    pub(super) fn position(&self, vertex: u32) -> Vec3 {
        let at = self.corners[vertex as usize].at;
        self.moved[vertex as usize] + Vec3::from_fn(|a, _| f64::from(at[a]) - 0.5)
    }

    /// Cuts every quadrilateral along its shorter diagonal.
    pub(super) fn choose_diagonals(&mut self) {
        let mut quads = std::mem::take(&mut self.quads);
        quads.par_iter_mut().for_each(|q| {
            let [a, b, c, d] = q.corners.map(|v| self.position(v));
            q.turned = (d - b).norm_squared() < (c - a).norm_squared();
        });
        self.quads = quads;
    }
}

/// All corners of a layer with the eight voxels around each.
struct Blocks<'a> {
    below: &'a [u8],
    above: &'a [u8],
    size: [usize; 2],
    next: usize,
    z: usize,
}

impl<'a> Blocks<'a> {
    fn new(grid: &'a Grid, z: usize) -> Self {
        Self {
            below: grid.layer(z - 1),
            above: grid.layer(z),
            size: [grid.size[0], grid.size[1]],
            next: 0,
            z,
        }
    }
}

impl Iterator for Blocks<'_> {
    type Item = ([u32; 3], [u8; 8]);

    fn next(&mut self) -> Option<Self::Item> {
        let [nx, ny] = self.size;
        let (x, y) = (1 + self.next % (nx - 1), 1 + self.next / (nx - 1));
        if y >= ny {
            return None;
        }
        self.next += 1;
        let first = x - 1 + nx * (y - 1);
        let block = std::array::from_fn(|c| {
            let layer = if c & 4 == 0 { self.below } else { self.above };
            layer[first + (c & 1) + nx * (c >> 1 & 1)]
        });
        Some(([x as u32, y as u32, self.z as u32], block))
    }
}

impl Corner {
    /// The vertices of one corner.
    fn all(at: [u32; 3], block: [u8; 8]) -> impl Iterator<Item = Self> {
        let solid = block.map(solid);
        let pinched = fans::pinched(solid, OUTSIDE);
        let sheets = fans::sheets(solid, pinched);
        let several = sheets.len() > 1;
        sheets.into_iter().map(move |faces| {
            let aside = if several {
                fans::aside(solid, faces, pinched)
            } else {
                None
            };
            Self::new(at, block, faces, pinched, aside)
        })
    }

    fn new(at: [u32; 3], block: [u8; 8], faces: u16, pinched: u8, aside: Option<Vec3>) -> Self {
        let mut locked = 0;
        for axis in 0..3 {
            let beyond = |side: usize| {
                (0..8)
                    .filter(|c| c >> axis & 1 == side)
                    .all(|c| block[c] == BEYOND)
            };
            locked |= u8::from(beyond(0) || beyond(1)) << axis;
        }
        let runs = fans::runs(faces);
        let mut lines = 0_u8;
        for direction in (0..6).filter(|d| runs >> d & 1 == 1) {
            let regions = fans::regions_along(block, faces, direction).len();
            lines |= u8::from(regions > 2) << direction;
        }
        // Where three regions meet in a line, the line itself is smoothed.
        let follows = if lines == 0 { runs } else { lines };
        Self {
            at,
            block,
            neighbours: [NONE; 6],
            follows,
            on_line: lines != 0,
            locked,
            faces,
            pinched,
            aside,
        }
    }
}

/// All vertices in one list, with their neighbours.
fn joined(grid: &Grid, by_layer: &[Vec<Corner>]) -> Vec<Corner> {
    let nx = grid.size[0];
    let area = nx * grid.size[1];
    let cell = |c: &Corner| c.at[0] as usize + nx * c.at[1] as usize;
    let mut start = vec![0_u32];
    for layer in by_layer {
        start.push(start[start.len() - 1] + layer.len() as u32);
    }
    let index = |layer: usize| {
        let mut index = vec![NONE; area];
        // The first of several vertices at one corner.
        for (n, corner) in by_layer[layer].iter().enumerate().rev() {
            index[cell(corner)] = start[layer] + n as u32;
        }
        index
    };
    let layers: Vec<Vec<Corner>> = (0..by_layer.len())
        .into_par_iter()
        .map(|l| {
            let own = index(l);
            let below = l.checked_sub(1).map(index);
            let above = (l + 1 < by_layer.len()).then(|| index(l + 1));
            let with_neighbours = |corner: &Corner| {
                let at = cell(corner);
                let mut corner = *corner;
                let runs = fans::runs(corner.faces);
                for direction in 0..6 {
                    if runs >> direction & 1 == 1 {
                        corner.neighbours[direction] = match direction {
                            0 => own[at - 1],
                            1 => own[at + 1],
                            2 => own[at - nx],
                            3 => own[at + nx],
                            4 => below.as_ref().map_or(NONE, |i| i[at]),
                            _ => above.as_ref().map_or(NONE, |i| i[at]),
                        };
                    }
                }
                corner
            };
            by_layer[l].iter().map(with_neighbours).collect()
        })
        .collect();
    let mut corners = layers.concat();
    let on_sheets: Vec<[u32; 6]> = corners.par_iter().map(|c| on_sheet(&corners, c)).collect();
    for (corner, neighbours) in corners.iter_mut().zip(on_sheets) {
        corner.neighbours = neighbours;
    }
    corners
}

/// The vertices at each neighbouring corner with which a vertex shares a face.
fn on_sheet(corners: &[Corner], corner: &Corner) -> [u32; 6] {
    std::array::from_fn(|direction| {
        let first = corner.neighbours[direction];
        let shared = fans::seen_from_next(corner.faces, direction);
        match shared.filter(|_| first != NONE) {
            Some(face) => with_face(corners, first, face),
            None => first,
        }
    })
}

/// The vertex with a face, among the vertices at the corner of vertex `v`.
fn with_face(corners: &[Corner], v: u32, face: usize) -> u32 {
    let at = corners[v as usize].at;
    let same = |w: &u32| corners[*w as usize].at == at;
    let first = (0..v).rev().take_while(same).last().unwrap_or(v);
    (first..corners.len() as u32)
        .take_while(same)
        .find(|w| corners[*w as usize].faces >> face & 1 == 1)
        .unwrap_or(v)
}

/// The faces whose lowest corner is this vertex.
fn quads_from<'a>(
    corners: &'a [Corner],
    v: u32,
    corner: &'a Corner,
) -> impl Iterator<Item = Quad> + 'a {
    (0..3).filter_map(move |axis| {
        let (u, w) = ((axis + 1) % 3, (axis + 2) % 3);
        if corner.faces >> face(axis, 1, 1) & 1 == 0 {
            return None;
        }
        let near = 1 << u | 1 << w;
        let sides = [near, near | 1 << axis].map(|c: usize| solid(corner.block[c]));
        let along_u = with_face(corners, corner.neighbours[2 * u + 1], face(axis, 0, 1));
        let along_w = with_face(corners, corner.neighbours[2 * w + 1], face(axis, 1, 0));
        let far = corners[along_u as usize].neighbours[2 * w + 1];
        let far = with_face(corners, far, face(axis, 0, 0));
        Some(Quad {
            corners: [v, along_u, far, along_w],
            axis: axis as u8,
            sides,
            turned: false,
        })
    })
}

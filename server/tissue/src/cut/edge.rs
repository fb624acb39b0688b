//! Resistance of the tissue along the edge of a cutting blade.
//!
//! The work of parting tissue is its toughness R times the area of the cut (Griffith 1921; for blades Atkins 2009), so an
//! edge that advances feels the force
//!
//! ```text
//! F = ∫ R dl        over the part of the edge in the tissue
//! ```
//!
//! The wound gapes behind the edge and, on a lattice, somewhat before it. A point between the two sides of a wound
//! therefore counts as tissue. Parted tissue needs no work: a point of the edge feels nothing while it moves along a surface that
//! a stroke has swept, and that continues ahead of it.

use super::BladePoint;
use super::edge_search::{Search, Visit};
use super::ribbon::Bounds;
use super::stroke_tree::{REACH, SweptPart};
use super::trilinear::{gradient, point};
use crate::{CutHistory, Shape, Topology, Vec3};

/// Length of a piece of the edge in which the tissue may change once, in spacings: half of the thinnest layer.
const PIECE: f64 = 0.5;
/// Most pieces; beyond them, those of a long edge are longer.
const PIECES_MAX: f64 = 64.0;
/// Halvings of a piece of the edge in which the tissue changes: to a hundredth of it.
const HALVINGS: usize = 6;
/// Pieces of the edge in one box of the search for strokes: a leaning edge has few strokes in its boxes.
const BOX: usize = 4;
/// How far ahead of the edge a swept surface must continue, in spacings: shapes of hand and server differ by less, so the edge
/// never runs after the end of its own stroke.
const AHEAD: f64 = 0.5;

/// Motion of the tip that determines the direction of an edge, m: twice that between two solves.
const TURN_M: f64 = 0.3e-3;

/// The path of an edge so far.
#[derive(Debug, Clone, Default)]
pub struct EdgeTrack {
    /// A cell near the edge.
    near: Option<u32>,
    /// The tip when its direction was determined.
    from: Option<Vec3>,
    /// Direction of the edge, across itself.
    ahead: Option<Vec3>,
}

impl EdgeTrack {
    /// Follows the edge to where its blade is.
    pub fn follow(&mut self, blade: &BladePoint) {
        let moved = blade.tip - *self.from.get_or_insert(blade.tip);
        if moved.norm() < TURN_M {
            return;
        }
        let across = moved - blade.axis * moved.dot(&blade.axis);
        self.ahead = across.try_normalize(0.5 * TURN_M).or(self.ahead);
        self.from = Some(blade.tip);
    }
}

/// The resistance against the edge of a blade.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EdgeResistance {
    /// Force against any motion across the edge, N.
    pub newtons: f64,
    /// Where it acts: distance from the tip along the edge, m.
    pub along_m: f64,
    /// Direction in which the edge moves, across itself; zero if it is unknown.
    pub ahead: Vec3,
}

/// The resistance against a blade in the deformed shape, after the strokes of `history`. `track` has followed the edge.
pub fn edge_resistance(
    topology: &Topology,
    shape: &Shape,
    history: &CutHistory,
    blade: &BladePoint,
    track: &mut EdgeTrack,
) -> EdgeResistance {
    let ahead = track.ahead.unwrap_or_default();
    let mut search = Search::new(topology, shape);
    let place = |along_m: f64| blade.tip + blade.axis * along_m;
    let pieces = blade.depth_m / (PIECE * topology.model.spacing_m);
    let pieces = pieces.ceil().clamp(1.0, PIECES_MAX) as usize;
    let along_m = |i: usize| blade.depth_m * i as f64 / pieces as f64;
    let ends: Vec<Option<Visit>> = (0..=pieces)
        .map(|i| search.find(place(along_m(i)), &mut track.near))
        .collect();
    let tissue = EdgeTissue::around(topology, shape, history, [blade.axis, ahead], &ends);
    let (mut newtons, mut moment) = (0.0, 0.0);
    let mut add = |toughness: f64, from: f64, to: f64| {
        newtons += toughness * (to - from);
        moment += toughness * (to * to - from * from) / 2.0;
    };
    let mut from = tissue.toughness(ends[0].as_ref());
    for i in 0..pieces {
        let [begin, end] = [i, i + 1].map(along_m);
        let to = tissue.toughness(ends[i + 1].as_ref());
        let mut change = begin;
        if from != to {
            let mut step = end - begin;
            search.cell = ends[i].map(|at| at.cell).or(search.cell);
            for _ in 0..HALVINGS {
                step *= 0.5;
                let middle = search.find(place(change + step), &mut track.near);
                if tissue.toughness(middle.as_ref()) == from {
                    change += step;
                }
            }
        }
        add(from, begin, change);
        add(to, change, end);
        from = to;
    }
    EdgeResistance {
        newtons,
        along_m: if newtons > 0.0 { moment / newtons } else { 0.0 },
        ahead,
    }
}

/// The tissue along the edge.
struct EdgeTissue<'a> {
    topology: &'a Topology,
    shape: &'a Shape,
    /// Directions in the deformed shape: along the edge, and in which it moves.
    directions: [Vec3; 2],
    /// Parts of strokes whose surfaces the edge may be on.
    wounds: Vec<&'a SweptPart>,
}

impl<'a> EdgeTissue<'a> {
    fn around(
        topology: &'a Topology,
        shape: &'a Shape,
        history: &'a CutHistory,
        directions: [Vec3; 2],
        points: &[Option<Visit>],
    ) -> Self {
        let mut tissue = Self {
            topology,
            shape,
            directions,
            wounds: Vec::new(),
        };
        // An edge that has not moved is nowhere along a surface.
        if directions[1] != Vec3::zeros() {
            let reach_m = (REACH + AHEAD) * topology.model.spacing_m;
            let last = points.len() - 1;
            let boxes = (0..last).step_by(BOX).map(|i| {
                let points = points[i..=(i + BOX).min(last)].iter().flatten();
                Bounds::around(points.map(|at| tissue.rest(at))).grown(reach_m)
            });
            tissue.wounds = history.swept().near(&boxes.collect::<Vec<_>>());
        }
        tissue
    }

    /// Toughness at a point of the edge in J/m²; 0 outside the tissue and where it is parted.
    fn toughness(&self, at: Option<&Visit>) -> f64 {
        let Some(at) = at.filter(|at| !self.is_parted(at)) else {
            return 0.0;
        };
        let material = self.topology.model.material_of(at.cell as usize);
        material.toughness_j_m2
    }

    /// Whether the edge moves along a swept surface that continues ahead of it.
    fn is_parted(&self, at: &Visit) -> bool {
        if self.wounds.is_empty() {
            return false;
        }
        let nodes = self.topology.corners(at.cell);
        let deformed = nodes.map(|n| self.shape.position(self.topology, n));
        let rest = nodes.map(|n| self.topology.rest(n));
        let local = at.inside();
        let Some(inverse) = gradient(&deformed, &local).try_inverse() else {
            return false;
        };
        let to_rest = gradient(&rest, &local) * inverse;
        let [along, ahead] = self.directions.map(|v| (to_rest * v).normalize());
        let normal = along.cross(&ahead).normalize();
        let spacing = self.topology.model.spacing_m;
        let place = point(&rest, &local);
        let is_swept = |place: &Vec3| {
            let mut wounds = self.wounds.iter();
            wounds.any(|wound| wound.is_along(place, &normal, spacing))
        };
        is_swept(&place) && is_swept(&(place + ahead * (AHEAD * spacing)))
    }

    /// The place of a point at rest.
    fn rest(&self, at: &Visit) -> Vec3 {
        let corners = self.topology.corners(at.cell);
        let corners = corners.map(|n| self.topology.rest(n));
        point(&corners, &at.inside())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::cell::NO_CELL;
    use crate::{CutStroke, Material, Model, StrokePart, block, cut};

    /// A block of 40 x 40 x 32 mm whose upper half is `tough`.
    fn layered(tough: f64) -> Topology {
        let mut model = block([10, 10, 8], 4e-3, &Material::default(), 4);
        for region in &mut model.regions {
            let is_base = region.name == "base";
            region.material.toughness_j_m2 = if is_base { 100.0 } else { tough };
        }
        Topology::new(Arc::new(model))
    }

    fn without_strokes(topology: &Topology) -> CutHistory {
        CutHistory::new(Arc::new(topology.clone()))
    }

    fn total(topology: &Topology, shape: &Shape, blade: &BladePoint) -> (f64, f64) {
        let (history, track) = (without_strokes(topology), &mut EdgeTrack::default());
        track.follow(blade);
        let edge = edge_resistance(topology, shape, &history, blade, track);
        (edge.newtons, edge.newtons * edge.along_m)
    }

    proptest! {
        /// Force and moment are the closed-form integrals over both layers, for any place, length and lean of the blade.
        #[test]
        fn resistance_is_the_integral_of_the_toughness(
            x in 0.012..0.028f64, y in 0.012..0.028f64, z in 1e-3..31e-3f64, length in 5e-3..40e-3f64, lean in -0.3..0.3f64,
        ) {
            let topology = layered(1_000.0);
            let shape = Shape::rest(&topology);
            let axis = Vec3::new(lean, 0.0, 1.0).normalize();
            let blade = BladePoint { tip: Vec3::new(x, y, z), axis, depth_m: length };
            let at = |height: f64| ((height - z) / axis.z).clamp(0.0, length);
            let (between, top) = (at(16e-3), at(32e-3));
            let force = 100.0 * between + 1_000.0 * (top - between);
            let moment = 50.0 * between.powi(2) + 500.0 * (top.powi(2) - between.powi(2));
            let (newtons, about_tip) = total(&topology, &shape, &blade);
            // The place of each change is known to 1/128 of a piece of half a spacing.
            let off = 1_000.0 * 2e-3 / 128.0;
            prop_assert!((newtons - force).abs() < 2.0 * off, "{newtons} {force}");
            prop_assert!((about_tip - moment).abs() < 2.0 * off * length, "{about_tip} {moment}");
        }
    }

    /// A block with strokes, in a shape.
    struct Wounded {
        topology: Arc<Topology>,
        history: CutHistory,
        /// Nodes at wounds.
        parted: Vec<u32>,
        bend: Bend,
    }

    /// A deformation: shear and stretch, a bow, and the width of wounds along x, m.
    #[derive(Debug, Clone, Copy)]
    struct Bend {
        shear: f64,
        stretch: f64,
        bow_m: f64,
        gap_m: f64,
    }

    impl Bend {
        fn at(&self, p: &Vec3) -> Vec3 {
            let bow = self.bow_m * (p.z / 16e-3 - 1.0).powi(2);
            let along = self.stretch * p.y + self.shear * p.z;
            Vec3::new(p.x + self.shear * p.y + bow, along, p.z - self.shear * p.x)
        }

        /// A blade that is upright in the tissue at rest.
        fn blade(&self, tip: &Vec3) -> BladePoint {
            let [tip, top] = [*tip, tip + Vec3::z() * 40e-3].map(|p| self.at(&p));
            BladePoint {
                tip,
                axis: (top - tip).normalize(),
                depth_m: (top - tip).norm(),
            }
        }
    }

    impl Wounded {
        fn new(bend: Bend) -> Self {
            let topology = Arc::new(layered(100.0));
            Self {
                history: CutHistory::new(Arc::clone(&topology)),
                topology,
                parted: Vec::new(),
                bend,
            }
        }

        /// Cuts along x = `x` from one y to another, in three parts.
        fn cut(&mut self, x: f64, z: f64, [from, to]: [f64; 2]) {
            let blade = |y: f64| BladePoint {
                tip: Vec3::new(x, y, z),
                axis: Vec3::z(),
                depth_m: 40e-3,
            };
            let at = |i: i32| blade(from + (to - from) * f64::from(i) / 12.0);
            for k in [0, 4, 8] {
                let path = CutStroke {
                    points: (k + i32::from(k > 0)..=k + 4).map(at).collect(),
                    width_m: 0.5e-3,
                };
                let part = StrokePart {
                    path,
                    stroke: Some(1),
                    joins: k > 0,
                };
                let outcome = self.history.cut(&mut self.topology, part).unwrap();
                let nodes = outcome.doubled.iter().flat_map(|d| [d.0, d.1]);
                self.parted.extend(nodes);
            }
        }

        fn shape(&self) -> Shape {
            let mut shape = Shape::rest(&self.topology);
            for (node, u) in (0..).zip(&mut shape.displacement) {
                let rest = self.topology.rest(node);
                *u = self.bend.at(&rest) - rest;
                if self.parted.contains(&node) {
                    let cells = self.topology.cells_around(node).into_iter();
                    let cells = cells.filter(|&c| c != NO_CELL);
                    let side: f64 = cells.map(|c| self.topology.centre(c).x - rest.x).sum();
                    u.x += 0.5 * self.bend.gap_m * side.signum();
                }
            }
            shape
        }

        /// Work of an edge along a straight path at rest, as the deformation moves it, J.
        fn work(&self, [from, to]: [Vec3; 2]) -> f64 {
            let (shape, mut track) = (self.shape(), EdgeTrack::default());
            let steps = ((to - from).norm() / 0.4e-3).ceil();
            let newtons = (0..steps as usize).map(|i| {
                let blade = self.bend.blade(&from.lerp(&to, i as f64 / steps));
                let (topology, history) = (&self.topology, &self.history);
                track.follow(&blade);
                edge_resistance(topology, &shape, history, &blade, &mut track).newtons
            });
            newtons.sum::<f64>() * (to - from).norm() / steps
        }
    }

    prop_compose! {
        fn bend()(shear in -0.2..0.2f64, stretch in 0.8..1.2f64, bow_m in -1e-3..1e-3f64, gap_m in 0.0..1.5e-3f64) -> Bend {
            Bend { shear, stretch, bow_m, gap_m }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn work_is_that_of_the_tissue_that_is_not_parted_yet(
            bend in bend(), x in 14e-3..26e-3f64, z in 10e-3..20e-3f64, end in 16e-3..30e-3f64,
        ) {
            const OUTSIDE: [f64; 2] = [-2e-3, 42e-3];
            let place = |x: f64, y: f64, z: f64| Vec3::new(x, y, z);
            let path = |x: f64, z: f64| OUTSIDE.map(|y| place(x, y, z));
            let (uncut, mut half, mut whole) = (Wounded::new(bend), Wounded::new(bend), Wounded::new(bend));
            half.cut(x, z, [OUTSIDE[0], end]);
            whole.cut(x, z, OUTSIDE);
            let first = uncut.work(path(x, z));
            let is_near = |a: f64, b: f64| (a - b).abs() < 0.05 * first;
            for backwards in [false, true] {
                let mut path = path(x, z);
                if backwards { path.reverse(); }
                let again = whole.work(path);
                prop_assert!(again < 0.05 * first, "{again} of {first}");
            }
            // The last half spacing of a wound counts as tissue.
            let (on, rest) = (half.work(path(x, z)), uncut.work([place(x, end - 2e-3, z), place(x, OUTSIDE[1], z)]));
            prop_assert!(is_near(on, rest), "{on} instead of {rest} of {first}");
            let (deeper, below) = (path(x, z - 6e-3), 100.0 * 6e-3 * 40e-3);
            let deeper = whole.work(deeper);
            prop_assert!((deeper - below).abs() < 0.05 * first + 0.2 * below, "{deeper} instead of {below}");
            for beside in [x - 4.5e-3, x + 4.5e-3] {
                let (beside, all) = (whole.work(path(beside, z)), uncut.work(path(beside, z)));
                prop_assert!(is_near(beside, all), "beside: {beside} instead of {all}");
            }
            let across = [-2e-3, 42e-3].map(|x| place(x, end, z));
            let (crossing, all) = (whole.work(across), uncut.work(across));
            prop_assert!(is_near(crossing, all), "across: {crossing} instead of {all}");
            whole.parted.clear();
            whole.history.undo(&mut whole.topology).unwrap();
            prop_assert_eq!(whole.work(path(x, z)), first);
        }
    }

    #[test]
    fn wound_that_gapes_around_the_edge_counts_as_tissue_and_a_wide_one_does_not() {
        let mut topology = layered(100.0);
        let point = |y| BladePoint {
            tip: Vec3::new(20e-3, y, 12e-3),
            axis: Vec3::z(),
            depth_m: 20e-3,
        };
        let stroke = CutStroke {
            points: vec![point(4e-3), point(36e-3)],
            width_m: 0.5e-3,
        };
        let outcome = cut(&mut topology, &stroke).unwrap();
        // At its front the widest is still narrow.
        for (open_m, newtons, off) in [(0.0, 2.0, 0.1), (1e-3, 2.0, 0.1), (8e-3, 0.0, 0.8)] {
            let mut shape = Shape::rest(&topology);
            for &(new, old) in &outcome.doubled {
                for node in [new, old] {
                    let cells = topology.cells_around(node);
                    let is_left = cells.iter().filter(|&&c| c != NO_CELL);
                    let x = is_left.map(|&c| topology.centre(c).x).sum::<f64>();
                    let count = cells.iter().filter(|&&c| c != NO_CELL).count() as f64;
                    shape.displacement[node as usize].x =
                        open_m / 2.0 * (x / count - 20e-3).signum();
                }
            }
            let (force, _) = total(&topology, &shape, &point(20e-3));
            assert!((force - newtons).abs() < off, "{open_m} {force}");
        }
    }

    #[test]
    fn edge_beside_the_tissue_has_no_resistance() {
        let topology = layered(100.0);
        let shape = Shape::rest(&topology);
        let beside = |tip| BladePoint {
            tip,
            axis: Vec3::z(),
            depth_m: 20e-3,
        };
        for tip in [
            Vec3::new(50e-3, 20e-3, 5e-3),
            Vec3::new(20e-3, 20e-3, 33e-3),
            Vec3::new(1.0, 1.0, 1.0),
            Vec3::new(f64::NAN, 0.0, 0.0),
        ] {
            assert_eq!(total(&topology, &shape, &beside(tip)), (0.0, 0.0));
        }
    }

    /// Distorted cells, as at the interfaces of a real model, and a wound that ends at the blade.
    #[test]
    fn resistance_is_continuous_along_the_path_of_a_cut() {
        let mut model = Model::clone(layered(1_000.0).model());
        for (i, node) in model.nodes.iter_mut().enumerate() {
            let t = i as f64;
            *node += Vec3::new(t.sin(), (1.7 * t).cos(), (0.3 * t).sin()) * 0.9e-3;
        }
        let mut topology = Topology::new(Arc::new(model));
        let point = |y: f64| BladePoint {
            tip: Vec3::new(19.3e-3, y, 11.3e-3),
            axis: Vec3::new(0.2, 0.1, 1.0).normalize(),
            depth_m: 30e-3,
        };
        let mut track = EdgeTrack::default();
        let mut last: Option<f64> = None;
        for step in 0..260 {
            let y = 6e-3 + 0.1e-3 * f64::from(step);
            if step > 0 && step % 100 == 0 {
                let points = (0..=step).map(|i| point(6e-3 + 0.1e-3 * f64::from(i)));
                let stroke = CutStroke {
                    points: points.collect(),
                    width_m: 0.5e-3,
                };
                // The cut itself moves nodes onto the path of the blade.
                last = None;
                cut(&mut topology, &stroke).unwrap();
            }
            let (shape, history) = (Shape::rest(&topology), without_strokes(&topology));
            track.follow(&point(y));
            let edge = edge_resistance(&topology, &shape, &history, &point(y), &mut track);
            let force = edge.newtons;
            if let Some(last) = last {
                assert!((force - last).abs() < 0.3, "at {y}: {last} {force}");
            }
            last = Some(force);
        }
    }
}

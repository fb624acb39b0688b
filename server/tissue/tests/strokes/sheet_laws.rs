//! Laws of the sheets of one stroke on an uncut model and of two that cross, and tallies of their nodes.

use std::collections::BTreeSet;

use palpate_tissue::cell::FACES;
use palpate_tissue::{CutError, CutStroke, SweptSurface, Topology, cut};
use rand::SeedableRng;
use rand_pcg::Pcg64;

use super::random_stroke::{crossing_stroke, pieces, random_stroke};
use super::sheet_figures::{Kind, cell_figures, drift, origin, sheet_nodes, wall_angles};

/// A node this near to the swept surface is on it, in spacings.
const ON: f64 = 0.05;
/// Least corner determinant and shortest spring of a cell that a cut moved, in spacings; less only where the cell had less
/// before.
const FLOORS: [f64; 2] = [0.0099, 0.2999];
/// Farthest that a node may leave its interfaces as built, in spacings.
const LIFT_MAX: f64 = 0.1;
/// Farthest that a node may be from where it was built, in spacings.
const DRIFT_MAX: f64 = 1.5;

/// Nodes of sheets that are not pinned.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) inside: [usize; 2],
    pub(crate) interface: [usize; 2],
    /// Nodes on the wall of an earlier stroke.
    pub(crate) crossing: [usize; 2],
    pub(crate) faces: usize,
    /// Sum of the squared angles between adjacent triangles inside, and their number.
    pub(crate) angles: (f64, usize),
    pub(crate) refused: usize,
}

impl Tally {
    pub(crate) fn add(&mut self, other: &Self) {
        let parts = [
            (&mut self.inside, other.inside),
            (&mut self.interface, other.interface),
            (&mut self.crossing, other.crossing),
        ];
        for (own, others) in parts {
            for (own, other) in own.iter_mut().zip(others) {
                *own += other;
            }
        }
        self.faces += other.faces;
        self.angles.0 += other.angles.0;
        self.angles.1 += other.angles.1;
        self.refused += other.refused;
    }

    /// Root mean square of the angle between adjacent triangles inside, in degrees.
    pub(crate) fn angle_deg(&self) -> f64 {
        (self.angles.0 / self.angles.1.max(1) as f64).sqrt()
    }

    /// Shares of the nodes inside, on interfaces and at crossings that are on the swept surface.
    pub(crate) fn shares(&self) -> [f64; 3] {
        let counts = [self.inside, self.interface, self.crossing];
        counts.map(|[on, all]| on as f64 / all.max(1) as f64)
    }
}

/// Number of strokes: `PALPATE_STROKES` if set.
pub(crate) fn count(default: u64) -> u64 {
    let set = std::env::var("PALPATE_STROKES");
    set.map_or(default, |n| n.parse().expect("PALPATE_STROKES is a number"))
}

/// Width of the cuts of a client, m. A node on the lip of such a wound is off the swept surface by half of it.
pub(crate) const OPEN_M: f64 = 5e-4;

/// Cuts an uncut model with `count` random strokes of a width in m, each from the beginning, as a whole or in pieces of a
/// length in m.
pub(crate) fn check(uncut: &Topology, count: u64, piece_m: Option<f64>, width_m: f64) -> Tally {
    let mut tally = Tally::default();
    for seed in 0..count {
        check_stroke(uncut, seed, piece_m, width_m, &mut tally);
    }
    tally
}

/// Cuts an uncut model with `count` pairs of random strokes of a width in m that cross, each pair from the beginning.
pub(crate) fn check_crossings(uncut: &Topology, count: u64, width_m: f64) -> Tally {
    let mut tally = Tally::default();
    for seed in 0..count {
        let mut random = Pcg64::seed_from_u64(seed);
        let spacing = uncut.model().spacing_m;
        let mut first = random_stroke(uncut, &mut random);
        let mut second = crossing_stroke(&first, spacing, &mut random);
        [first.width_m, second.width_m] = [width_m; 2];
        let mut t = uncut.clone();
        if cut(&mut t, &first).is_err() {
            tally.refused += 1;
            continue;
        }
        let opened = t.boundary().faces.len();
        let walls = &t.boundary().faces[uncut.boundary().faces.len()..];
        let corners = walls
            .iter()
            .flat_map(|&f| FACES[f.face()].map(|i| t.corners(f.cell())[i]));
        let walls: BTreeSet<u32> = corners.map(|n| origin(&t, n)).collect();
        if cut(&mut t, &second).is_ok() {
            check_result(uncut, &t, seed, &second, opened, &walls, &mut tally);
        } else {
            tally.refused += 1;
        }
    }
    tally
}

fn mass(t: &Topology) -> f64 {
    (0..t.node_count() as u32).map(|n| t.mass(n)).sum()
}

fn check_stroke(
    uncut: &Topology,
    seed: u64,
    piece_m: Option<f64>,
    width_m: f64,
    tally: &mut Tally,
) {
    let spacing = uncut.model().spacing_m;
    let mut stroke = random_stroke(uncut, &mut Pcg64::seed_from_u64(seed));
    stroke.width_m = width_m;
    let strokes = match piece_m {
        None => vec![stroke.clone()],
        Some(length) => pieces(&stroke, length, spacing),
    };
    let mut t = uncut.clone();
    for stroke in &strokes {
        let hash = t.hash();
        match cut(&mut t, stroke) {
            Ok(_) => assert_ne!(t.hash(), hash, "stroke {seed}"),
            Err(error) => {
                assert_eq!(t.hash(), hash, "stroke {seed}");
                let is_reason = error == CutError::NothingNew || error.to_string().len() > 20;
                assert!(is_reason, "stroke {seed}: {error}");
            }
        }
    }
    if t.version() == 0 {
        tally.refused += 1;
        return;
    }
    let opened = uncut.boundary().faces.len();
    check_result(uncut, &t, seed, &stroke, opened, &BTreeSet::new(), tally);
}

/// Laws of a cut model; counts the nodes of the faces that `stroke` opened, which come after `opened` others.
fn check_result(
    uncut: &Topology,
    t: &Topology,
    seed: u64,
    stroke: &CutStroke,
    opened: usize,
    walls: &BTreeSet<u32>,
    tally: &mut Tally,
) {
    let spacing = uncut.model().spacing_m;
    let surface = SweptSurface::of(stroke, spacing).unwrap();
    assert!(t.boundary().is_closed(), "stroke {seed}");
    let gained = mass(t) / mass(uncut) - 1.0;
    assert!(gained.abs() < 1e-12, "stroke {seed}: mass by {gained:e}");
    for c in 0..t.cell_count() as u32 {
        let [now, before] = [t, uncut].map(|t| t.corners(c).map(|n| t.rest(n)));
        if now != before {
            let [now, before] = [&now, &before].map(|x| cell_figures(x, spacing));
            for i in 0..2 {
                let is_sound = now[i] >= FLOORS[i] || now[i] >= before[i];
                assert!(is_sound, "stroke {seed}, cell {c}: {now:?} of {before:?}");
            }
        }
    }
    for n in 0..t.node_count() as u32 {
        let built = t.model().nodes[origin(t, n) as usize];
        let drift = (t.rest(n) - built).norm() / spacing;
        assert!(
            drift <= DRIFT_MAX + 1e-9,
            "stroke {seed}, node {n}: {drift}"
        );
    }
    tally.faces += t.boundary().faces.len() - opened;
    let angles = wall_angles(uncut, t, opened);
    tally.angles.0 += angles.iter().sum::<f64>();
    tally.angles.1 += angles.len();
    for node in sheet_nodes(uncut, t, opened, &surface) {
        let drift = drift(uncut, t, node.node);
        assert!(
            drift <= LIFT_MAX,
            "stroke {seed}, node {}: {drift}",
            node.node
        );
        let counts = match node.kind {
            Kind::Inside | Kind::Interface if walls.contains(&origin(t, node.node)) => {
                &mut tally.crossing
            }
            Kind::Inside => &mut tally.inside,
            Kind::Interface => &mut tally.interface,
            Kind::Pinned => continue,
        };
        counts[0] += usize::from(node.off <= ON);
        counts[1] += 1;
    }
}

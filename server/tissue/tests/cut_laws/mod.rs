//! Invariants of a whole topology.

#![allow(clippy::unwrap_used)]
// Each test file uses a part of it.
#![allow(dead_code)]

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use palpate_tissue::cell::{FACES, NO_CELL, PAIRS, cell_volume};
use palpate_tissue::{BladePoint, CutStroke, FaceId, Material, Topology, Vec3, block};

pub(crate) fn rubber() -> Material {
    Material {
        name: "rubber".into(),
        young_pa: 1e5,
        density_kg_m3: 1100.0,
        friction_static: 0.5,
        friction_dynamic: 0.4,
        source: "made up for this test".into(),
        ..Material::default()
    }
}

pub(crate) fn topology(cells: [usize; 3], spacing: f64) -> Topology {
    Topology::new(Arc::new(block(cells, spacing, &rubber(), 0)))
}

pub(crate) fn stroke(tips: &[Vec3], axis: Vec3, depth_m: f64) -> CutStroke {
    let point = |&tip: &Vec3| BladePoint { tip, axis, depth_m };
    CutStroke {
        points: tips.iter().map(point).collect(),
        width_m: 0.0,
    }
}

/// Quantities that a cut conserves.
pub(crate) struct Outline {
    pub(crate) volume: f64,
    pub(crate) mass: f64,
}

impl Outline {
    pub(crate) fn of(t: &Topology) -> Self {
        Self {
            volume: volume(t),
            mass: mass(t),
        }
    }
}

pub(crate) fn volume(t: &Topology) -> f64 {
    (0..t.cell_count() as u32).map(|c| t.volume(c)).sum()
}

fn mass(t: &Topology) -> f64 {
    (0..t.node_count() as u32).map(|n| t.mass(n)).sum()
}

/// All laws, with volume and mass exact: for cuts through flat surfaces.
pub(crate) fn check_all(t: &Topology, before: &Outline) {
    check_within(t, before, 1e-12);
}

/// All laws. Nodes that slid along the crooked sides of older cuts may have changed volume and mass by a small
/// fraction.
pub(crate) fn check_within(t: &Topology, before: &Outline, part: f64) {
    check_surface(t);
    check_cells(t);
    check_derived(t);
    let (v, m) = (volume(t) / before.volume - 1.0, mass(t) / before.mass - 1.0);
    assert!(v.abs() < part, "volume changed by {v:e}");
    assert!(m.abs() < part, "mass changed by {m:e}");
}

/// Every edge of the boundary is in exactly two triangles, once each way round.
pub(crate) fn check_surface(t: &Topology) {
    let mut edges = BTreeMap::<(u32, u32), (u32, u32)>::new();
    let boundary = t.boundary();
    assert_eq!(boundary.triangles.len(), 2 * boundary.faces.len());
    for tri in &boundary.triangles {
        for i in 0..3 {
            let (a, b) = (tri[i], tri[(i + 1) % 3]);
            let uses = edges.entry((a.min(b), a.max(b))).or_default();
            if a < b {
                uses.0 += 1;
            } else {
                uses.1 += 1;
            }
        }
    }
    for (edge, uses) in edges {
        assert_eq!(uses, (1, 1), "edge {edge:?}");
    }
}

/// Valid cells: a positive determinant at every corner, and springs long enough.
pub(crate) fn check_cells(t: &Topology) {
    let spacing = t.model().spacing_m;
    for cell in 0..t.cell_count() as u32 {
        let x = t.corners(cell).map(|n| t.rest(n));
        for c in 0..8usize {
            let e = |a: usize| {
                let out = x[c ^ (1 << a)] - x[c];
                if c >> a & 1 == 0 { out } else { -out }
            };
            let span = e(0).cross(&e(1)).dot(&e(2)) / spacing.powi(3);
            assert!(span > 0.0099, "cell {cell} corner {c}: {span}");
        }
        for [a, b] in PAIRS.iter().filter(|[a, b]| (a ^ b).count_ones() < 3) {
            let length = (x[*a] - x[*b]).norm() / spacing;
            assert!(length > 0.299, "cell {cell}: a spring of {length}");
        }
    }
}

/// All data derived from corners, cuts and rest positions equal those of a new derivation.
pub(crate) fn check_derived(t: &Topology) {
    let nodes = t.node_count();
    let mut slots = vec![[NO_CELL; 8]; nodes];
    let mut mass = vec![0.0; nodes];
    let mut springs = vec![BTreeMap::<u32, f64>::new(); nodes];
    for cell in 0..t.cell_count() as u32 {
        let corners = t.corners(cell);
        let x = corners.map(|n| t.rest(n));
        let v = cell_volume(&x);
        assert_eq!(v, t.volume(cell));
        let material = t.model().material_of(cell as usize);
        for (slot, &n) in corners.iter().enumerate() {
            slots[n as usize][slot] = cell;
            let built = cell_volume(&t.model().corners_of(cell as usize));
            mass[n as usize] += material.density_kg_m3 * built / 8.0;
        }
        for [a, b] in PAIRS {
            let share = [0.14, 0.24, 0.36][(a ^ b).count_ones() as usize - 1];
            let length = (x[a] - x[b]).norm().max(0.5 * t.model().spacing_m);
            let k = share * material.young_pa * v / (length * length);
            *springs[corners[a] as usize].entry(corners[b]).or_default() += k;
            *springs[corners[b] as usize].entry(corners[a]).or_default() += k;
        }
    }
    for n in 0..nodes {
        let node = n as u32;
        assert_eq!(slots[n], t.cells_around(node));
        assert!((mass[n] / t.mass(node) - 1.0).abs() < 1e-12, "mass of {n}");
        let row = t.springs_of(node);
        assert_eq!(row.len(), springs[n].len());
        for (s, (&to, &k)) in row.iter().zip(&springs[n]) {
            assert_eq!(s.to, to);
            assert!((f64::from(s.stiffness) / k - 1.0).abs() < 1e-6);
        }
        let pinned = slots[n]
            .iter()
            .any(|&c| c != NO_CELL && t.model().regions[t.region(c).index()].pinned);
        assert_eq!(t.is_pinned(node), pinned);
    }
    let mut exposed = BTreeSet::new();
    for cell in 0..t.cell_count() as u32 {
        for (face, corners) in FACES.iter().enumerate() {
            let id = FaceId::new(cell, face);
            let other = t.across(id);
            if other == NO_CELL {
                exposed.insert(id);
            } else {
                assert_eq!(t.across(FaceId::new(other, face ^ 1)), cell);
                for &c in corners {
                    let across = c ^ (1 << (face / 2));
                    assert_eq!(t.corners(cell)[c], t.corners(other)[across]);
                }
            }
        }
    }
    let boundary = t.boundary();
    let listed: BTreeSet<FaceId> = boundary.faces.iter().copied().collect();
    assert_eq!(listed.len(), boundary.faces.len());
    assert_eq!(listed, exposed);
    for (face, pair) in boundary.faces.iter().zip(boundary.triangles.chunks(2)) {
        let [a, b, c, d] = FACES[face.face()].map(|i| t.corners(face.cell())[i]);
        let ways = [[[a, b, c], [a, c, d]], [[a, b, d], [b, c, d]]];
        assert!(ways.iter().any(|w| w[..] == *pair));
    }
}

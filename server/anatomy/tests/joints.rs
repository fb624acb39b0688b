//! Bodies that touch on a part of their surface only: the gap beside it stays open.

#![allow(clippy::unwrap_used)]

mod shapes;

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_anatomy::{BuildReport, ContactReport, SceneInput, Surface, build};
use palpate_tissue::{Topology, Vec3};
use shapes::{cuboid, placed, scene};

/// m.
const SPACING: f64 = 2e-3;
/// Half the side of both bodies, and their heights, in spacings.
const HALF: f64 = 8.0;
const HEIGHT: f64 = 6.0;

/// Euler angles of the bodies.
const TURNS: [[f64; 3]; 4] = [
    [0.0; 3],
    [0.35, 0.52, 0.7],
    [1.1, 0.25, 2.3],
    [std::f64::consts::FRAC_PI_4, 0.615_480, 0.0],
];

/// A body above a plane, whose lower side has these heights at these places along x, in spacings.
fn above(lower: &[[f64; 2]]) -> Surface {
    let mut surface = Surface::default();
    for y in [-HALF, HALF] {
        for &[x, z] in lower {
            for z in [z, HEIGHT] {
                surface.vertices.push(Vec3::new(x, y, z) * SPACING);
            }
        }
    }
    let count = lower.len() as u32;
    let at = |i: u32, far: u32, upper: u32| 2 * (far * count + i) + upper;
    let mut quad = |[a, b, c, d]: [u32; 4]| surface.triangles.extend([[a, b, c], [a, c, d]]);
    for i in 0..count - 1 {
        quad([at(i, 0, 0), at(i + 1, 0, 0), at(i + 1, 0, 1), at(i, 0, 1)]);
        quad([at(i, 1, 1), at(i + 1, 1, 1), at(i + 1, 1, 0), at(i, 1, 0)]);
        quad([at(i, 0, 0), at(i, 1, 0), at(i + 1, 1, 0), at(i + 1, 0, 0)]);
        quad([at(i, 0, 1), at(i + 1, 0, 1), at(i + 1, 1, 1), at(i, 1, 1)]);
    }
    let last = count - 1;
    quad([at(0, 0, 0), at(0, 0, 1), at(0, 1, 1), at(0, 1, 0)]);
    quad([
        at(last, 0, 0),
        at(last, 1, 0),
        at(last, 1, 1),
        at(last, 0, 1),
    ]);
    surface
}

/// The two bodies at a place.
fn bodies(lower: &[[f64; 2]], turn: [f64; 3]) -> SceneInput {
    let at = Vec3::new(0.37, 0.53, 0.71) * SPACING;
    let low = Vec3::new(-HALF, -HALF, -HEIGHT) * SPACING;
    let high = Vec3::new(HALF, HALF, 0.0) * SPACING;
    let surfaces = [cuboid(low, high), above(lower)].map(|s| placed(s, turn, at));
    scene(&format!("{}", SPACING * 1e3), &surfaces).unwrap()
}

/// The report of a sound model of them.
fn built(lower: &[[f64; 2]], turn: [f64; 3]) -> BuildReport {
    let (model, report) = build(&bodies(lower, turn), &mut |_, _| {}).unwrap();
    // Contact uses the triangles of the topology.
    let topology = Topology::new(Arc::new(model));
    let boundary = topology.boundary();
    assert_eq!(boundary.triangles.len(), report.outer_surface.triangles);
    let mut edges: BTreeMap<[u32; 2], usize> = BTreeMap::new();
    for t in &boundary.triangles {
        for [a, b] in [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]] {
            *edges.entry([a.min(b), a.max(b)]).or_default() += 1;
        }
    }
    assert!(edges.values().all(|uses| *uses == 2), "{turn:?}");
    assert_eq!(report.quality.bad_cells, 0, "{:?}", report.quality);
    assert_eq!(report.surface_faults, [], "{turn:?}");
    assert_eq!(report.outer_surface.components, 1, "{turn:?}");
    for region in &report.regions {
        let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
        assert!(error.abs() < 5e-3, "{turn:?}: {region:?}");
        assert!(region.dice > 0.97, "{turn:?}: {region:?}");
    }
    report
}

/// Area in mm² where the two touch in the model and not in the input.
fn created(report: &BuildReport) -> f64 {
    report.contacts.iter().map(|c| c.created_mm2).sum()
}

#[test]
fn gap_beside_a_contact_stays_open() {
    for gap in [0.4, 0.6, 0.9] {
        for turn in TURNS {
            let report = built(&[[-HALF, 0.0], [0.0, 0.0], [0.1, gap], [HALF, gap]], turn);
            let whole = area(HALF);
            assert!(created(&report) < 0.02 * whole, "{gap}, {turn:?}");
            let open: f64 = report.gaps.iter().map(|g| g.area_mm2).sum();
            assert!(gap > 0.5 || open > 0.8 * whole, "{turn:?}: {open}");
        }
    }
}

#[test]
fn wedge_is_open_from_an_eighth_of_a_spacing_on() {
    for width in [0.6, 1.0, 2.0] {
        for turn in TURNS {
            let report = built(&[[-HALF, 0.0], [0.0, 0.0], [HALF, width]], turn);
            // A contact within a spacing of that of the input is none that was created; steps of the lattice add another.
            let narrow = HALF * 0.125 / width;
            let most = area(narrow + 1.0);
            assert!(created(&report) < most, "{width}, {turn:?}");
        }
    }
}

/// A lower side that touches the plane every eight spacings and is so many spacings above it half way between.
fn waves(height: f64) -> Vec<[f64; 2]> {
    (0..=64)
        .map(|i| {
            let x = HALF * (f64::from(i) / 32.0 - 1.0);
            [
                x,
                height * (1.0 - (x * std::f64::consts::FRAC_PI_4).cos()) / 2.0,
            ]
        })
        .collect()
}

#[test]
fn gap_that_ends_at_many_contacts_stays_open() {
    for height in [0.6, 1.0] {
        for turn in TURNS {
            let report = built(&waves(height), turn);
            assert!(report.gaps[0].area_mm2 > 200.0, "{height}, {turn:?}");
            assert_eq!(created(&report), 0.0, "{height}, {turn:?}");
            let kept = |c: &ContactReport| c.removed_mm2 < 0.1 * c.input_mm2;
            assert!(report.contacts.iter().all(kept), "{:?}", report.contacts);
        }
    }
}

/// A body between a plane at a height and waves in both directions above another height, in spacings.
fn crate_side(plane: f64, waves: f64) -> Surface {
    const COUNT: u32 = 36;
    let mut surface = Surface::default();
    for i in 0..COUNT * COUNT {
        let [x, y] = [i % COUNT, i / COUNT].map(|k| f64::from(k) * 0.4 - 7.0);
        let [u, v] = [x, y].map(|x| (x * std::f64::consts::FRAC_PI_3).sin());
        let heights = [plane, waves + 2.0 * u * v];
        let ends = heights.map(|z| Vec3::new(x, y, z) * SPACING);
        surface.vertices.extend(ends);
    }
    let at = |x: u32, y: u32, upper: u32| 2 * (y * COUNT + x) + upper;
    let mut quad = |[a, b, c, d]: [u32; 4]| surface.triangles.extend([[a, b, c], [a, c, d]]);
    let last = COUNT - 1;
    for (i, j) in (0..last * last).map(|k| (k % last, k / last)) {
        let corners = |upper| {
            [
                at(i, j, upper),
                at(i + 1, j, upper),
                at(i + 1, j + 1, upper),
                at(i, j + 1, upper),
            ]
        };
        quad(corners(1));
        let [a, b, c, d] = corners(0);
        quad([a, d, c, b]);
    }
    for i in 0..last {
        quad([at(i, 0, 0), at(i + 1, 0, 0), at(i + 1, 0, 1), at(i, 0, 1)]);
        quad([
            at(i + 1, last, 0),
            at(i, last, 0),
            at(i, last, 1),
            at(i + 1, last, 1),
        ]);
        quad([at(0, i + 1, 0), at(0, i, 0), at(0, i, 1), at(0, i + 1, 1)]);
        quad([
            at(last, i, 0),
            at(last, i + 1, 0),
            at(last, i + 1, 1),
            at(last, i, 1),
        ]);
    }
    if plane > waves {
        surface.triangles.iter_mut().for_each(|t| t.swap(0, 1));
    }
    surface
}

#[test]
fn sides_of_a_rough_narrow_gap_pass_through_each_other_nowhere() {
    for turn in TURNS {
        let at = Vec3::new(0.37, 0.53, 0.71) * SPACING;
        let bodies = [crate_side(-6.0, 0.0), crate_side(6.0, 0.16)];
        let surfaces = bodies.map(|s| placed(s, turn, at));
        let input = scene(&format!("{}", SPACING * 1e3), &surfaces).unwrap();
        let (_, report) = build(&input, &mut |_, _| {}).unwrap();
        assert!(report.gaps[0].area_mm2 > 500.0, "{turn:?}");
        assert_eq!(report.surface_faults, [], "{turn:?}");
        assert_eq!(report.quality.bad_cells, 0, "{turn:?}");
        for region in &report.regions {
            let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
            assert!(error.abs() < 0.01, "{turn:?}: {region:?}");
        }
    }
}

#[test]
fn film_on_one_side_of_a_gap_holds_nothing() {
    for turn in TURNS {
        let [low, high] = [-HALF, HALF].map(|side| Vec3::new(side, side, 0.0) * SPACING);
        let up = Vec3::z() * SPACING;
        let below = cuboid(low - HEIGHT * up, high);
        let film = cuboid(low, high + 0.1 * up);
        let above = above(&[[-HALF, 0.7], [HALF, 0.7]]);
        let at = Vec3::new(0.37, 0.53, 0.71) * SPACING;
        let surfaces = [below, above, film].map(|s| placed(s, turn, at));
        let input = scene(&format!("{}", SPACING * 1e3), &surfaces).unwrap();
        let (_, report) = build(&input, &mut |_, _| {}).unwrap();
        assert_eq!(created(&report), 0.0, "{turn:?}");
        assert_eq!(report.outer_surface.components, 2, "{turn:?}");
    }
}

#[test]
fn joint_is_equal_on_any_thread_count_and_closed_where_the_scene_fuses() {
    let mut input = bodies(&[[-HALF, 0.0], [0.0, 0.0], [HALF, 0.6]], TURNS[1]);
    let on = |threads: usize, input: &SceneInput| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().unwrap();
        pool.install(|| build(input, &mut |_, _| {}).unwrap().1)
    };
    let report = on(1, &input);
    assert!(report.gaps.iter().map(|g| g.faces).sum::<usize>() > 20);
    assert_eq!(report.topology_hash, on(3, &input).topology_hash);
    input.scene.fuse = vec![[0, 1]];
    assert_eq!(on(3, &input).gaps, []);
}

/// Area of a strip of this width, in mm².
fn area(width: f64) -> f64 {
    width * 2.0 * HALF * (SPACING * 1e3).powi(2)
}

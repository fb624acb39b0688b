//! Layers of about one spacing keep their place.

#![allow(clippy::unwrap_used)]

mod shapes;

use palpate_anatomy::{BuildReport, RegionReport, SceneInput, Surface, build};
use palpate_tissue::Vec3;
use shapes::{ball, cuboid, placed, scene};

/// In mm.
const SPACING: f64 = 4.0;
/// Radius of a ball or half the side of a box, in m.
const SIZE: f64 = 0.04;
/// Sizes of the same, in m, that put walls along the lattice on its planes, in the middle of cells and between.
const SIZES: [f64; 4] = [0.04, 0.0405, 0.041, 0.0417];

/// Euler angles of the layers of boxes: oblique, and across the body diagonal of the lattice.
const TURNS: [[f64; 3]; 2] = [
    [0.35, 0.52, 0.7],
    [std::f64::consts::FRAC_PI_4, 0.615_480, 0.0],
];

/// A body around a core, apart by `thickness` spacings. With `within` the layer lies in a third tissue.
fn layer(turn: Option<[f64; 3]>, outer: f64, within: bool, thickness: f64) -> SceneInput {
    let at = Vec3::new(0.37, 0.53, 0.71) * 1e-3;
    let body = |size: f64| -> Surface {
        match turn {
            None => placed(ball(size), [0.2, 0.3, 0.1], at),
            Some(turn) => placed(cuboid(-Vec3::repeat(size), Vec3::repeat(size)), turn, at),
        }
    };
    let core = outer - thickness * SPACING * 1e-3;
    let mut surfaces = vec![body(outer), body(core)];
    if within {
        surfaces.insert(0, body(outer + 0.012));
    }
    scene(&format!("{SPACING}"), &surfaces).unwrap()
}

fn built(input: &SceneInput) -> BuildReport {
    let (_, report) = build(input, &mut |_, _| {}).unwrap();
    assert_eq!(report.quality.bad_cells, 0, "{:?}", report.quality);
    assert!(report.outer_surface.closed);
    assert!(report.regions.iter().all(|r| r.surface.closed));
    report
}

/// The layer of [`layer`] in the report.
fn own(report: &BuildReport) -> &RegionReport {
    &report.regions[report.regions.len() - 2]
}

#[test]
fn layer_down_to_half_a_spacing_keeps_its_place() {
    for turn in [None, Some(TURNS[0]), Some(TURNS[1])] {
        for (within, thickness, least) in [
            (false, 0.5, 0.93),
            (true, 0.5, 0.93),
            (false, 1.0, 0.96),
            (true, 1.0, 0.96),
        ] {
            let case = format!("{turn:?}, within {within}, {thickness} spacings");
            keeps_its_place(&layer(turn, SIZE, within, thickness), least, &case);
        }
    }
}

fn keeps_its_place(input: &SceneInput, least: f64, case: &str) {
    let report = built(input);
    let own = own(&report);
    assert!(own.dice > least, "{case}: {}", own.dice);
    let error = own.volume_mm3 / own.input_volume_mm3 - 1.0;
    assert!(error.abs() < 1e-3, "{case}: {error}");
    assert_eq!(own.components, 1, "{case}");
}

#[test]
fn layer_along_the_lattice_keeps_its_place_between_its_planes() {
    for size in SIZES {
        for (within, thickness) in [(false, 0.5), (true, 0.5), (false, 0.75), (true, 1.0)] {
            let case = format!("{size} m, within {within}, {thickness} spacings");
            let input = layer(Some([0.0; 3]), size, within, thickness);
            keeps_its_place(&input, 0.95, &case);
        }
    }
}

#[test]
fn layer_has_no_edge_at_which_the_regions_on_its_sides_meet() {
    // The cells of the two sides of this layer of one spacing would share edges.
    let at = Vec3::new(0.37, 0.21, 0.13) * 1e-3;
    let body = |half: f64| {
        let half = Vec3::repeat(half);
        placed(cuboid(-half, half), TURNS[1], at)
    };
    let surfaces = [0.03, 0.022, 0.018].map(body);
    let input = scene(&format!("{SPACING}"), &surfaces).unwrap();
    keeps_its_place(&input, 0.95, "box");
}

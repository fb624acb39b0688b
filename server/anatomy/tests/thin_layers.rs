//! Layers of about one spacing keep their place.

#![allow(clippy::unwrap_used)]

mod shapes;

use std::f64::consts::TAU;

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
            (false, 0.5, 0.94),
            (true, 0.5, 0.94),
            (false, 1.0, 0.97),
            (true, 1.0, 0.97),
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
            keeps_its_place(&input, 0.98, &case);
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
    keeps_its_place(&input, 0.96, "box");
}

/// Euler angles and places, in spacings, at which an oblique layer is built.
const TILTS: [([f64; 3], [f64; 3]); 6] = [
    (TURNS[0], [0.37, 0.53, 0.71]),
    (TURNS[1], [0.12, 0.84, 0.45]),
    ([1.1, 0.25, 2.3], [0.9, 0.31, 0.66]),
    ([4.4, 5.3, 0.6], [0.05, 0.48, 0.22]),
    ([2.7, 1.9, 3.9], [0.61, 0.17, 0.93]),
    ([5.8, 3.4, 1.5], [0.28, 0.72, 0.08]),
];

#[test]
fn oblique_shell_of_a_box_keeps_its_place_at_six_tilts() {
    let spacing = SPACING * 1e-3;
    for (turn, at) in TILTS {
        let body = |half: f64| {
            let half = Vec3::repeat(half * spacing);
            placed(cuboid(-half, half), turn, Vec3::from(at) * spacing)
        };
        let surfaces = [8.5, 5.5, 5.0].map(body);
        let input = scene(&format!("{SPACING}"), &surfaces).unwrap();
        keeps_its_place(&input, 0.915, &format!("box at {turn:?}"));
    }
}

#[test]
fn sheet_across_a_body_keeps_its_place_at_six_tilts() {
    // Height of the waves in spacings.
    for waves in [0.0, 1.0] {
        for (turn, at) in TILTS {
            let surfaces = sheet(waves, 0.5)
                .map(|surface| placed(surface, turn, Vec3::from(at) * SPACING * 1e-3));
            let input = scene(&format!("{SPACING}"), &surfaces).unwrap();
            keeps_its_place(&input, 0.9, &format!("waves of {waves} at {turn:?}"));
        }
    }
}

/// A cube of 14 spacings, and its parts below the upper and the lower side of a sheet. Waves are 10 spacings long in both
/// directions.
fn sheet(waves: f64, thickness: f64) -> [Surface; 3] {
    let number = TAU / 10.0;
    let side = |sign: f64| {
        move |x: f64, y: f64| {
            let (along, across) = (number * x, number * y + 0.5);
            let slope = waves * number * along.cos().hypot(across.sin());
            let half = thickness / 2.0 * slope.hypot(1.0);
            waves * (along.sin() + across.cos()) + sign * half
        }
    };
    [below(|_, _| HALF), below(side(1.0)), below(side(-1.0))]
}

/// Half the side of the cube of [`sheet`], in spacings.
const HALF: f64 = 7.0;

/// The part of the cube of [`sheet`] below a height, both in spacings.
fn below(height: impl Fn(f64, f64) -> f64) -> Surface {
    const SIDES: usize = 56;
    let at = |i: usize| HALF * (2.0 * i as f64 / SIDES as f64 - 1.0);
    let number = |i: usize, j: usize, upper: bool| {
        (i + (SIDES + 1) * (j + (SIDES + 1) * usize::from(upper))) as u32
    };
    let mut surface = Surface::default();
    for upper in [false, true] {
        for (j, i) in (0..=SIDES).flat_map(|j| (0..=SIDES).map(move |i| (j, i))) {
            let z = if upper { height(at(i), at(j)) } else { -HALF };
            let vertex = Vec3::new(at(i), at(j), z) * SPACING * 1e-3;
            surface.vertices.push(vertex);
        }
    }
    let mut quad = |corners: [(usize, usize, bool); 4]| {
        let [a, b, c, d] = corners.map(|(i, j, upper)| number(i, j, upper));
        surface.triangles.extend([[a, b, c], [a, c, d]]);
    };
    for n in 0..SIDES {
        for m in 0..SIDES {
            let ring = [(n, m), (n + 1, m), (n + 1, m + 1), (n, m + 1)];
            quad(ring.map(|(i, j)| (i, j, true)));
            let [a, b, c, d] = ring.map(|(i, j)| (i, j, false));
            quad([a, d, c, b]);
        }
        let (next, end) = (n + 1, SIDES);
        for [a, b] in [
            [(n, 0), (next, 0)],
            [(next, end), (n, end)],
            [(0, next), (0, n)],
            [(end, n), (end, next)],
        ] {
            let corners = [(a, false), (b, false), (b, true), (a, true)];
            quad(corners.map(|((i, j), upper)| (i, j, upper)));
        }
    }
    surface
}

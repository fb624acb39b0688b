//! Unusual, thin, invalid or oversized input.

#![allow(clippy::unwrap_used)]

mod shapes;

use palpate_anatomy::{BuildReport, SceneInput, Surface, ThinKind, build};
use palpate_tissue::{Model, Vec3};
use shapes::{ball, cuboid, cylinder, placed, scene, together};

fn built(input: &SceneInput) -> (Model, BuildReport) {
    let (model, report) = build(input, &mut |_, _| {}).unwrap();
    assert_eq!(report.quality.bad_cells, 0, "{:?}", report.quality);
    assert!(report.outer_surface.closed);
    assert!(report.regions.iter().all(|r| r.surface.closed));
    (model, report)
}

fn volume_error(report: &BuildReport, region: usize) -> f64 {
    let region = &report.regions[region];
    region.volume_mm3 / region.input_volume_mm3 - 1.0
}

/// A unit box in mm.
fn slab(low: [f64; 3], high: [f64; 3]) -> Surface {
    cuboid(Vec3::from(low) * 1e-3, Vec3::from(high) * 1e-3)
}

#[test]
fn neighbours_with_a_common_wall_share_its_nodes() {
    // The wall at x = 0 consists of the same triangles with opposite windings, as between two labels.
    let left = slab([-31.0, -20.0, -20.0], [0.0, 20.0, 20.0]);
    let right = slab([0.0, -20.0, -20.0], [29.0, 20.0, 20.0]);
    for spacing in ["3.0", "3.7", "4.0"] {
        let (model, report) = built(&scene(spacing, &[left.clone(), right.clone()]).unwrap());
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        for r in 0..2 {
            assert!(volume_error(&report, r).abs() < 0.01, "{report:?}");
        }
        assert!(report.thin.parts.is_empty(), "{:?}", report.thin);
        // Two outer interfaces and one between them, whose nodes lie in the plane of the wall.
        assert_eq!(report.layers.len(), 3);
        let layers = palpate_anatomy::Layers::new(&model);
        let wall = layers.layers.iter().find(|l| l.outside.is_some()).unwrap();
        for &node in &wall.nodes {
            let x = model.nodes[node as usize].x;
            assert!(x.abs() < 0.2e-3, "{:?}", model.nodes[node as usize]);
        }
    }
}

#[test]
fn common_walls_of_many_neighbours_leave_no_gap() {
    let at = |i: usize| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|b| b as f64 * 20.0);
    let blocks: Vec<Surface> = (0..8)
        .map(|i| slab(at(i), at(i).map(|x| x + 20.0)))
        .collect();
    let (_, report) = built(&scene("3.3", &blocks).unwrap());
    let whole: f64 = report.regions.iter().map(|r| r.volume_mm3).sum();
    assert!((whole / 64e3 - 1.0).abs() < 0.005, "{whole}");
    assert_eq!(report.outer_surface.components, 1);
    for r in 0..8 {
        assert!(volume_error(&report, r).abs() < 0.02, "{report:?}");
    }
}

#[test]
fn thin_layer_is_reported_with_position() {
    let outer = slab([-30.0, -30.0, 0.0], [30.0, 30.0, 30.0]);
    // The first region keeps two millimetres on top, and far more at the sides.
    let inner = slab([-20.0, -20.0, 0.0], [20.0, 20.0, 28.0]);
    let (_, report) = built(&scene("5.0", &[outer, inner]).unwrap());
    let part = report
        .thin
        .parts
        .iter()
        .find(|p| p.kind == ThinKind::Layer && p.region.as_deref() == Some("r0"))
        .unwrap();
    assert!((part.thickness_mean_mm - 2.0).abs() < 0.1, "{part:?}");
    assert!(
        part.centre_mm[2] > 26.0 && part.centre_mm[0].abs() < 3.0,
        "{part:?}"
    );
    // Both of its sides, 1600 mm² each.
    assert!((2400.0..4000.0).contains(&part.area_mm2), "{part:?}");
    assert_eq!(part.between, [Some("r1".to_owned()), None], "{part:?}");
}

#[test]
fn lost_thin_wall_is_reported() {
    let cone = together(&[cylinder(0.01, 0.02), {
        let mut hole = cylinder(0.0095, 0.0195);
        hole.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        hole
    }]);
    let body = placed(ball(0.012), [0.0; 3], Vec3::new(0.0, 0.0, 0.03));
    let (_, report) = built(&scene("2.0", &[body, cone]).unwrap());
    let lost: f64 = report.thin.parts.iter().map(|p| p.lost_area_mm2).sum();
    assert!(lost > 1000.0, "{:?}", report.thin);
    assert!(
        report.warnings.iter().any(|w| w.contains("r1")),
        "{:?}",
        report.warnings
    );
}

#[test]
fn duplicate_crossing_and_inverted_triangles_keep_the_model() {
    let plain = ball(0.02);
    let (model, _) = built(&scene("3.0", std::slice::from_ref(&plain)).unwrap());
    let mut doubled = plain.clone();
    doubled.triangles.extend_from_slice(&plain.triangles[..200]);
    let mut inside_out = plain.clone();
    inside_out.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    let mut mixed = plain;
    mixed
        .triangles
        .iter_mut()
        .step_by(3)
        .for_each(|t| t.swap(1, 2));
    for odd in [doubled, inside_out, mixed] {
        let (same, _) = built(&scene("3.0", &[odd]).unwrap());
        assert_eq!(same.nodes, model.nodes);
    }
    // Two balls that intersect in one surface.
    let crossing = together(&[ball(0.015), placed(ball(0.015), [0.3; 3], Vec3::x() * 0.01)]);
    let (_, report) = built(&scene("2.5", &[crossing]).unwrap());
    assert_eq!(report.regions[0].components, 1);
}

#[test]
fn separate_components_stay_separate() {
    let drops: Vec<Surface> = (0..27)
        .map(|i| [i % 3, i / 3 % 3, i / 9].map(|j| f64::from(j - 1) * 0.02))
        .map(|at| placed(ball(0.006), [0.0; 3], Vec3::from(at)))
        .collect();
    let body = slab([-35.0; 3], [35.0; 3]);
    let (_, report) = built(&scene("2.5", &[body, together(&drops)]).unwrap());
    assert_eq!(report.regions[1].components, 27);
    assert_eq!(report.regions[1].input_components, 27);
    let layer = report
        .layers
        .iter()
        .find(|l| l.outside.as_deref() == Some("r0"))
        .unwrap();
    assert_eq!(layer.components, 27);
    assert!(volume_error(&report, 1).abs() < 0.02);
}

#[test]
fn error_for_wrong_unit_names_the_likely_unit() {
    let mut tiny = ball(0.1);
    tiny.vertices.iter_mut().for_each(|v| *v *= 1e-3);
    let input = scene("4.0", &[tiny]).unwrap();
    let said = build(&input, &mut |_, _| {}).unwrap_err().to_string();
    assert!(
        said.contains("metres") && said.contains("unit = \"m\""),
        "{said}"
    );
    let mut huge = ball(0.1);
    huge.vertices.iter_mut().for_each(|v| *v *= 1e3);
    let input = scene("4.0", &[huge]).unwrap();
    let said = build(&input, &mut |_, _| {}).unwrap_err().to_string();
    assert!(said.contains("millimetres"), "{said}");
}

#[test]
fn input_too_far_from_the_origin_is_rejected_before_building() {
    for far in [12e3, -2e5] {
        let mut ball = ball(0.1);
        ball.vertices.iter_mut().for_each(|v| v.x += far);
        let input = scene("4.0", &[ball]).unwrap();
        let said = build(&input, &mut |_, _| {}).unwrap_err().to_string();
        assert!(
            said.contains("origin") && said.contains("10000 m"),
            "{said}"
        );
    }
}

#[test]
fn automatic_spacing_is_thinnest_layer_or_given_minimum() {
    let outer = placed(ball(0.03), [0.0; 3], Vec3::zeros());
    let inner = placed(ball(0.026), [0.0; 3], Vec3::zeros());
    let (model, report) = built(&scene("\"auto\"", &[outer.clone(), inner.clone()]).unwrap());
    let search = report.spacing_search.unwrap();
    assert!((3.5e-3..5e-3).contains(&model.spacing_m), "{search:?}");
    assert!(search.distances > 1000 && search.quantile_mm >= search.smallest_mm);
    let least = scene("\"auto\"\nspacing_min_mm = 6.0", &[outer, inner]).unwrap();
    assert!((built(&least).0.spacing_m - 6e-3).abs() < 1e-9);
}

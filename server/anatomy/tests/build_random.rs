//! Invariants of every model, for random input shapes.

#![allow(clippy::unwrap_used)]

mod shapes;

use palpate_anatomy::{BuildReport, Layers, SPRING_FLOOR, Surface, build, region_surface};
use palpate_tissue::cell::cell_volume;
use palpate_tissue::{Model, RegionId, Vec3};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use shapes::{ball, cuboid, cylinder, placed, scene};

/// Relative tolerance of the volumes where nothing of the region is thin.
const VOLUME: f64 = 0.02;

/// Checks the invariants on the model itself, independently of its report.
fn assert_sound(model: &Model, report: &BuildReport) {
    let mut volumes = vec![0.0; model.regions.len()];
    for (index, cell) in model.cells.iter().enumerate() {
        let corners = model.corners_of(index).map(|p| p / model.spacing_m);
        for c in 0..8 {
            let edge = |a: usize| {
                let to = corners[c ^ (1 << a)] - corners[c];
                if c >> a & 1 == 1 { -to } else { to }
            };
            let det = edge(0).dot(&edge(1).cross(&edge(2)));
            assert!(det > 0.0, "cell {index} corner {c}: {det}");
            for d in c + 1..8 {
                let length = (corners[c] - corners[d]).norm();
                assert!(length >= SPRING_FLOOR - 1e-9, "cell {index}: {length}");
            }
        }
        volumes[cell.region.index()] += cell_volume(&corners) * model.spacing_m.powi(3);
    }
    assert!(report.outer_surface.closed);
    for (r, region) in report.regions.iter().enumerate() {
        assert!((region.volume_mm3 * 1e-9 - volumes[r]).abs() < 1e-12);
        let triangles = region_surface(model, RegionId(r as u16));
        assert_closed(&triangles);
        let surface = Surface {
            vertices: model.nodes.clone(),
            triangles,
        };
        assert!(surface.volume() >= 0.0, "{region:?}");
    }
    assert_eq!(report.quality.inverted_cells + report.quality.bad_cells, 0);
}

/// Every edge is used once in each direction: closed, and wound consistently.
fn assert_closed(triangles: &[[u32; 3]]) {
    let edges = |t: &[u32; 3]| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]];
    let mut forth: Vec<[u32; 2]> = triangles.iter().flat_map(edges).collect();
    let mut back: Vec<[u32; 2]> = forth.iter().map(|[a, b]| [*b, *a]).collect();
    forth.sort_unstable();
    back.sort_unstable();
    assert_eq!(forth, back);
    forth.dedup();
    assert_eq!(forth.len(), back.len());
}

/// A ball, a box or a tilted cylinder of some 20 to 40 mm, its middle within `reach` of the origin.
fn shape(reach: f64) -> impl Strategy<Value = Surface> {
    let size = || 0.008..0.02_f64;
    let angle = || -1.5..1.5_f64;
    let at = move || prop::array::uniform3(-reach..reach);
    (
        0..3_u8,
        size(),
        size(),
        size(),
        [angle(), angle(), angle()],
        at(),
    )
        .prop_map(|(kind, a, b, c, angles, at)| {
            let body = match kind {
                0 => ball(a),
                1 => cuboid(-Vec3::new(a, b, c), Vec3::new(a, b, c)),
                _ => cylinder(a, b),
            };
            placed(body, angles, Vec3::from(at))
        })
}

/// Two boxes of which a corner ends between two layers of the lattice's nodes: the worst of 1,300 random cases.
#[test]
fn corner_between_lattice_layers_is_kept() {
    for seed in [191, 1277] {
        let mut random = rand_pcg::Pcg64::seed_from_u64(seed);
        let mut between = |a: f64, b: f64| a + (b - a) * random.random::<f64>();
        let size = Vec3::from([(); 3].map(|()| between(0.008, 0.02)));
        assert!(between(0.0, 3.0) >= 1.0, "neither is a ball");
        let angles = [(); 3].map(|()| between(-1.5, 1.5));
        let at = Vec3::from([(); 3].map(|()| between(-0.004, 0.004)));
        let inner = placed(cuboid(-size, size), angles, at);
        let turn = [(); 3].map(|()| between(-1.5, 1.5));
        let outer = placed(cylinder(0.04, 0.045), turn, Vec3::zeros());
        let spacing = between(2.0, 3.0);
        let input = scene(&format!("{spacing}"), &[outer, inner]).unwrap();
        let (model, report) = build(&input, &mut |_, _| {}).unwrap();
        assert_sound(&model, &report);
        let off = report.regions[1].input_distance_max_mm.unwrap() / spacing;
        assert!(off < 0.65, "seed {seed}: {off}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn nested_touching_or_crossing_shapes_give_valid_models(
        first in shape(1e-6), more in prop::collection::vec(shape(0.02), 0..4), spacing in 2.0..4.0_f64,
    ) {
        let surfaces: Vec<Surface> = std::iter::once(first).chain(more).collect();
        let input = scene(&format!("{spacing}"), &surfaces).unwrap();
        let (model, report) = build(&input, &mut |_, _| {}).unwrap();
        assert_sound(&model, &report);
        for region in &report.regions {
            let thin = report.thin.parts.iter().any(|p| {
                let names = [&p.region, &p.between[0], &p.between[1]];
                names.contains(&&Some(region.name.clone()))
            });
            // A region that later ones cover has no volume to compare.
            let thin = thin || region.input_volume_mm3 == 0.0;
            let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
            prop_assert!(thin || error.abs() < VOLUME, "{region:?}");
        }
        // Layers contain every face between regions once.
        let layers = Layers::new(&model);
        let faces: usize = layers.layers.iter().map(|l| l.triangles.len()).sum();
        let sides: usize = report.regions.iter().map(|r| r.surface.triangles).sum();
        prop_assert_eq!(2 * faces, sides + report.outer_surface.triangles);
    }

    #[test]
    fn nested_shapes_keep_their_volumes(
        inner in shape(0.004), turn in prop::array::uniform3(-1.5..1.5_f64), spacing in 2.0..3.0_f64,
    ) {
        // Nothing is thin here: the wall around the inner shape is a few spacings thick.
        let outer = placed(cylinder(0.04, 0.045), turn, Vec3::zeros());
        let input = scene(&format!("{spacing}"), &[outer, inner]).unwrap();
        let (model, report) = build(&input, &mut |_, _| {}).unwrap();
        assert_sound(&model, &report);
        for region in &report.regions {
            let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
            prop_assert!(error.abs() < VOLUME, "{region:?}");
            prop_assert_eq!(region.components, 1);
            prop_assert_eq!(region.input_components, 1);
            prop_assert!(region.surface_distance_mean_mm < 0.1 * spacing, "{region:?}");
            prop_assert!(region.distance_max_outside_thin_mm < 0.75 * spacing, "{region:?}");
        }
        prop_assert_eq!(report.layers.iter().map(|l| l.components).collect::<Vec<_>>(), [1, 1]);
    }
}

//! The builder against shapes of known volume.

use std::f64::consts::PI;

use std::sync::Arc;

use palpate_tissue::Topology;

use super::*;
use crate::scene::Scene;

/// A closed body of revolution about z with the given profile of (radius, z), capped flat.
pub(super) fn turned(profile: &[(f64, f64)], sides: usize) -> Surface {
    let mut surface = Surface::default();
    let ring = |at: usize, s: usize| (at * sides + s % sides) as u32;
    for &(r, z) in profile {
        for s in 0..sides {
            let angle = 2.0 * PI * s as f64 / sides as f64;
            surface
                .vertices
                .push(Vec3::new(r * angle.cos(), r * angle.sin(), z));
        }
    }
    for at in 0..profile.len() - 1 {
        for s in 0..sides {
            let [a, b, c, d] = [
                ring(at, s),
                ring(at, s + 1),
                ring(at + 1, s + 1),
                ring(at + 1, s),
            ];
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    for (at, up) in [(0, false), (profile.len() - 1, true)] {
        let middle = surface.vertices.len() as u32;
        surface.vertices.push(Vec3::new(0.0, 0.0, profile[at].1));
        for s in 0..sides {
            let (a, b) = (ring(at, s), ring(at, s + 1));
            surface
                .triangles
                .push(if up { [a, b, middle] } else { [b, a, middle] });
        }
    }
    surface
}

/// A box with its edges along the axes.
pub(super) fn cuboid(low: Vec3, high: Vec3) -> Surface {
    let corner = |c: usize| Vec3::from_fn(|a, _| if c >> a & 1 == 1 { high[a] } else { low[a] });
    let faces = palpate_tissue::cell::FACES.map(|f| f.map(|c| c as u32));
    Surface {
        vertices: (0..8).map(corner).collect(),
        triangles: faces
            .iter()
            .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect(),
    }
}

/// One surface with the triangles of both.
pub(super) fn both(mut one: Surface, other: &Surface) -> Surface {
    let first = one.vertices.len() as u32;
    one.vertices.extend(&other.vertices);
    let triangles = other.triangles.iter();
    one.triangles
        .extend(triangles.map(|t| t.map(|v| v + first)));
    one
}

pub(super) fn ball(radius: f64) -> Surface {
    let profile: Vec<(f64, f64)> = (1..48)
        .map(|i| PI * f64::from(i) / 48.0)
        .map(|a| (radius * a.sin(), -radius * a.cos()))
        .collect();
    turned(&profile, 96)
}

pub(super) fn scene(spacing_mm: f64, regions: &[(&str, Surface)]) -> SceneInput {
    let head = format!("format = \"palpate-scene/1\"\nspacing_mm = {spacing_mm}\n");
    let tables = regions.iter().map(|(name, _)| {
        format!("[[region]]\nname = \"{name}\"\nsurface = \"{name}.stl\"\nmaterial = \"fat\"\n")
    });
    let text: String = std::iter::once(head).chain(tables).collect();
    let scene = Scene::parse(&text, std::path::Path::new(".")).unwrap();
    SceneInput::new(scene, regions.iter().map(|r| r.1.clone()).collect()).unwrap()
}

pub(super) fn built(spacing_mm: f64, regions: &[(&str, Surface)]) -> (Model, BuildReport) {
    build(&scene(spacing_mm, regions), &mut |_, _| {}).unwrap()
}

/// Edges of surfaces that do not belong to two triangles, and pairs of triangles that pass through each other.
pub(super) fn surface_faults(report: &BuildReport) -> usize {
    let regions = report.regions.iter().map(|r| &r.surface);
    let surfaces = std::iter::once(&report.outer_surface).chain(regions);
    let faults = surfaces.map(|s| s.edges_not_two + s.self_intersections);
    faults.sum::<usize>() + report.surface_intersections
}

pub(super) fn assert_sound(model: &Model, report: &BuildReport) {
    assert!(report.outer_surface.closed, "{report:?}");
    assert_eq!(surface_faults(report), 0, "{:?}", report.surface_faults);
    assert_eq!(report.quality.inverted_cells, 0, "{report:?}");
    assert_eq!(report.quality.bad_cells, 0, "{report:?}");
    assert!(report.quality.shortest_spring >= SPRING_FLOOR, "{report:?}");
    for region in &report.regions {
        let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
        assert!(error.abs() < 0.02, "{region:?}");
    }
    // The mass of the model must equal density times volume, regardless of the lattice.
    let topology = Topology::new(Arc::new(model.clone()));
    assert_eq!(report.topology_hash, topology.hash().to_string());
    let kinds = report.springs;
    let sum = kinds.structural + kinds.shear + kinds.body_diagonal + kinds.layer;
    let ends: usize = (0..topology.node_count() as u32)
        .map(|n| topology.springs_of(n).len())
        .sum();
    assert_eq!(sum, ends / 2);
    let outside = SurfaceReport {
        self_intersections: report.outer_surface.self_intersections,
        ..report_triangles(&topology.boundary().triangles)
    };
    assert_eq!(report.outer_surface, outside);
    let mass: f64 = (0..topology.node_count() as u32)
        .map(|n| topology.mass(n))
        .sum();
    let volumes: f64 = (0..model.cells.len())
        .map(|c| topology.volume(c as u32) * model.material_of(c).density_kg_m3)
        .sum();
    assert!((mass / volumes - 1.0).abs() < 1e-12);
}

#[test]
fn unpinned_pieces_under_gravity_are_reported() {
    let beside = ball(0.008);
    let mut apart = beside.clone();
    for p in &mut apart.vertices {
        *p += Vec3::new(0.014, 0.014, 0.0);
    }
    let mut input = scene(1.0, &[("held", beside), ("loose", apart)]);
    let falls = |input: &SceneInput| {
        let (_, report) = build(input, &mut |_, _| {}).unwrap();
        let named = |w: &&String| w.contains("fall for ever");
        report.warnings.iter().filter(named).count()
    };
    input.scene.pinned = vec!["held".to_owned()];
    assert_eq!(falls(&input), 0, "without gravity no piece falls");
    input.scene.gravity_m_s2 = [0.0, 0.0, -9.81];
    assert_eq!(falls(&input), 1);
    input.scene.pinned.push("loose".to_owned());
    assert_eq!(falls(&input), 0);
}

#[test]
fn ball_keeps_its_volume_and_surface_nodes_lie_on_it() {
    for spacing in [4.0, 8.0] {
        let (model, report) = built(spacing, &[("ball", ball(0.0375))]);
        assert_sound(&model, &report);
        assert_eq!(report.outer_surface.components, 1);
        assert!(
            report.regions[0].surface_distance_mean_mm < 0.1 * spacing,
            "{report:?}"
        );
    }
}

#[test]
fn parts_without_cells_are_reported_with_position() {
    // A grain of a quarter of a cell, and a tip that never fills half a cell: the tip is not thin, and lost.
    let tip = turned(
        &[
            (0.006, -0.02),
            (0.006, 0.0),
            (0.0018, 0.001),
            (0.0018, 0.012),
        ],
        48,
    );
    let moved = |mut surface: Surface, by: Vec3| {
        surface.vertices.iter_mut().for_each(|v| *v += by);
        surface
    };
    let grain = moved(ball(0.0015), Vec3::new(0.0, 0.02, 0.0));
    let regions = [("body", ball(0.04)), ("tip", tip), ("grain", grain)];
    let (_, report) = built(4.0, &regions);
    let kinds = |name: &str| -> Vec<ThinKind> {
        let own = report.thin.parts.iter();
        let own = own.filter(|p| p.region.as_deref() == Some(name));
        own.map(|p| p.kind).collect()
    };
    assert!(kinds("grain").contains(&ThinKind::Speck), "{report:?}");
    assert!(kinds("tip").contains(&ThinKind::Crumb), "{report:?}");
    for region in &report.regions {
        let off = region.distance_max_outside_thin_mm;
        assert!(off <= 0.75 * 4.0, "{}: {off}", region.name);
    }
}

#[test]
fn nested_and_protruding_regions_share_conforming_interfaces() {
    let skin = turned(&[(0.05, -0.06), (0.05, 0.06)], 128);
    let bone = turned(&[(0.02, -0.06), (0.02, 0.06)], 64);
    let (model, report) = built(4.0, &[("skin", skin), ("bone", bone)]);
    assert_sound(&model, &report);
    // Region volumes are measured on shared nodes, so they add up to the whole.
    let whole: f64 = report.regions.iter().map(|r| r.volume_mm3).sum();
    let exact = PI * 50.0 * 50.0 * 120.0;
    assert!((whole / exact - 1.0).abs() < 0.01, "{whole} {exact}");
}

#[test]
fn every_interface_has_one_layer_of_model_springs() {
    let skin = turned(&[(0.05, -0.06), (0.05, 0.06)], 128);
    let bone = turned(&[(0.02, -0.06), (0.02, 0.06)], 64);
    let marrow = ball(0.012);
    let regions = [("skin", skin), ("bone", bone), ("marrow", marrow)];
    let (model, report) = built(4.0, &regions);
    assert_sound(&model, &report);
    let layers = Layers::new(&model);
    let components: Vec<usize> = report.layers.iter().map(|l| l.components).collect();
    // Skin and bone reach the outside, the bone at both of its ends.
    let kinds: Vec<_> = layers
        .layers
        .iter()
        .map(|l| (l.inside.0, l.outside))
        .collect();
    assert_eq!(components, [1, 1, 2, 1], "{kinds:?}");
    let topology = Topology::new(Arc::new(model.clone()));
    for layer in &layers.layers {
        for [a, b] in &layer.springs {
            let row = topology.springs_of(*a);
            assert!(row.iter().any(|s| s.to == *b), "{a} {b}");
        }
        let mut degree = std::collections::BTreeMap::<u32, usize>::new();
        for node in layer.springs.iter().flatten() {
            *degree.entry(*node).or_default() += 1;
        }
        assert_eq!(degree.len(), layer.nodes.len());
        assert!(degree.values().all(|d| (2..=12).contains(d)));
    }
    for (r, region) in report.regions.iter().enumerate() {
        let triangles = region_surface(&model, palpate_tissue::RegionId(r as u16));
        assert!(report_triangles(&triangles).closed);
        let surface = Surface {
            vertices: model.nodes.clone(),
            triangles,
        };
        let volume = surface.volume() * 1e9;
        assert!(
            (volume / region.volume_mm3 - 1.0).abs() < 0.02,
            "{volume} {region:?}"
        );
    }
}

#[test]
fn rims_stay_sharp() {
    let (model, _) = built(5.0, &[("drum", turned(&[(0.04, 0.0), (0.04, 0.05)], 128))]);
    let highest = model.nodes.iter().filter(|p| (p.z - 0.05).abs() < 1e-6);
    let reach = highest.map(|p| p.xy().norm()).fold(0.0, f64::max);
    assert!((reach - 0.04).abs() < 2e-4, "{reach}");
}

#[test]
fn model_is_equal_on_any_thread_count() {
    let hash = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| built(6.0, &[("ball", ball(0.04))]).1.topology_hash)
    };
    assert_eq!(hash(1), hash(3));
}

#[test]
fn too_coarse_or_too_fine_spacing_is_rejected_with_a_remedy() {
    let refuse = |spacing| {
        build(&scene(spacing, &[("ball", ball(0.02))]), &mut |_, _| {})
            .unwrap_err()
            .to_string()
    };
    let coarse = refuse(100.0);
    assert!(coarse.contains("too coarse"), "{coarse}");
    let fine = refuse(0.01);
    assert!(
        fine.contains("limits") && fine.contains("use spacing_mm"),
        "{fine}"
    );
}

#[test]
fn region_outside_the_outermost_is_rejected_by_name() {
    let mut far = ball(0.01);
    for v in &mut far.vertices {
        v.x += 1.0;
    }
    let input = scene(4.0, &[("body", ball(0.03)), ("stray", far)]);
    let error = build(&input, &mut |_, _| {}).unwrap_err().to_string();
    assert!(
        error.contains("stray") && error.contains("outside"),
        "{error}"
    );
}

#[test]
fn region_beside_the_others_becomes_a_part_of_its_own() {
    let mut beside = ball(0.02);
    for v in &mut beside.vertices {
        v.x += 0.055;
    }
    let (model, report) = built(4.0, &[("body", ball(0.03)), ("knob", beside)]);
    assert_sound(&model, &report);
    assert_eq!(report.outer_surface.components, 2);
    assert!(report.contacts.is_empty(), "{:?}", report.contacts);
    let named = |w: &&String| w.contains("\"knob\" lies beside the others, 5.0 mm");
    let named = report.warnings.iter().filter(named).count();
    assert_eq!((named, report.deviations), (1, 0), "{:?}", report.warnings);
}

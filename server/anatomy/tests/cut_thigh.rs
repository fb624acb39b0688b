//! Cuts in a model with layers and a curved skin: the built-in thigh, and a real one when `PALPATE_DATA` names its folder.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "../../tissue/tests/cut_laws/mod.rs"]
mod cut_laws;

mod real_models;

use std::sync::Arc;

use palpate_anatomy::sample::Sample;
use palpate_anatomy::{Surface, Unit, build};
use palpate_tissue::cell::NO_CELL;
use palpate_tissue::file::{ModelFile, decode_model, encode_model};
use palpate_tissue::{
    BladePoint, Budget, CutHistory, CutStroke, EdgeTrack, FaceId, Shape, Tissue, Tool, Topology,
    Vec3, block, cut, edge_resistance,
};

fn thigh() -> Topology {
    let input = Sample::Thigh.input().unwrap();
    let (model, _) = build(&input, &mut |_, _| ()).unwrap();
    Topology::new(Arc::new(model))
}

fn region_volumes(t: &Topology) -> Vec<f64> {
    let mut volumes = vec![0.0; t.model().regions.len()];
    for cell in 0..t.cell_count() as u32 {
        volumes[t.region(cell).index()] += t.volume(cell);
    }
    volumes
}

/// A stroke along z over the front of the thigh, its tip `depth` under the skin.
fn incision(t: &Topology, from: f64, to: f64, depth: f64) -> CutStroke {
    let nodes = &t.model().nodes;
    let (low, high) = nodes.iter().fold(
        (Vec3::repeat(f64::MAX), Vec3::repeat(f64::MIN)),
        |(l, h), p| (l.inf(p), h.sup(p)),
    );
    let size = high - low;
    let axis = Vec3::new(0.2, 1.0, 0.1).normalize();
    let steps = 20;
    let points = (0..=steps).map(|i| {
        let s = from + (to - from) * f64::from(i) / f64::from(steps);
        let x = low.x + size.x * (0.5 + 0.05 * (4.0 * s).sin());
        let z = low.z + size.z * s;
        // The skin above x, z: the highest node around.
        let near = |p: &&Vec3| (p.x - x).hypot(p.z - z) < 1.5 * t.model().spacing_m;
        let top = nodes
            .iter()
            .filter(near)
            .map(|p| p.y)
            .fold(f64::MIN, f64::max);
        BladePoint {
            tip: Vec3::new(x, top, z) - axis * depth,
            axis,
            depth_m: depth + 0.006,
        }
    });
    CutStroke {
        points: points.collect(),
        width_m: 0.0,
    }
}

fn worst_cell(t: &Topology) -> f64 {
    let cells = (0..t.cell_count() as u32).map(|c| t.volume(c));
    cells.fold(f64::MAX, f64::min) / t.model().spacing_m.powi(3)
}

#[test]
fn incision_through_layers_keeps_surface_and_volumes() {
    let mut t = thigh();
    cut_laws::check_surface(&t);
    let (before, worst) = (region_volumes(&t), worst_cell(&t));
    for (from, to, depth) in [(0.3, 0.7, 0.012), (0.3, 0.7, 0.03), (0.5, 0.8, 0.02)] {
        let stroke = incision(&t, from, to, depth);
        let outcome = cut(&mut t, &stroke).unwrap();
        cut_laws::check_surface(&t);
        let (after, now) = (region_volumes(&t), worst_cell(&t));
        println!(
            "{} faces, {} snapped, {} short, regions {:?}, worst cell {worst:.3} -> {now:.3}",
            outcome.faces_opened, outcome.nodes_snapped, outcome.nodes_short, outcome.regions_cut
        );
        for (a, b) in after.iter().zip(&before) {
            assert!((a / b - 1.0).abs() < 5e-3, "{a} of {b}");
        }
        assert!(now > 0.0 || now >= worst);
    }
    assert_eq!(t.components(), 1);
}

#[test]
fn deep_incision_exposes_all_layers_on_both_sides() {
    let mut t = thigh();
    let built = t.boundary().faces.len();
    let stroke = incision(&t, 0.35, 0.65, 0.03);
    let outcome = cut(&mut t, &stroke).unwrap();
    assert!(outcome.regions_cut.len() >= 2, "{:?}", outcome.regions_cut);
    let opened = &t.boundary().faces[built..];
    assert_eq!(opened.len(), 2 * outcome.faces_opened);
    for &region in &outcome.regions_cut {
        let of = |f: &&FaceId| t.region(f.cell()) == region;
        assert!(opened.iter().filter(of).count() > 0);
    }
    assert!(opened.iter().all(|&f| t.across(f) == NO_CELL));
}

#[test]
fn thigh_model_file_round_trip() {
    let t = thigh();
    let bytes = encode_model(t.model());
    println!("{} nodes in {} bytes", t.node_count(), bytes.len());
    let model = decode_model(&bytes).unwrap();
    assert_eq!(&model, &**t.model());
    let other = ModelFile {
        model: block([2, 2, 2], 0.01, &cut_laws::rubber(), 0),
        report_json: String::new(),
    };
    assert_ne!(other.encode(), bytes);
}

/// Volume in m³ of the part of a closed surface on the side of a plane that its normal points to. The face that closes the
/// part lies in the plane and contributes nothing, because the origin of the tetrahedra does too.
fn clipped_volume(surface: &Surface, origin: &Vec3, normal: &Vec3) -> f64 {
    let mut sixfold = 0.0;
    for triangle in 0..surface.triangles.len() {
        let corners = surface.corners(triangle).map(|p| p - origin);
        let mut inside: Vec<Vec3> = Vec::new();
        for i in 0..3 {
            let [from, to] = [corners[i], corners[(i + 1) % 3]];
            let [a, b] = [from.dot(normal), to.dot(normal)];
            if a >= 0.0 {
                inside.push(from);
            }
            if (a >= 0.0) != (b >= 0.0) {
                inside.push(from + (to - from) * (a / (a - b)));
            }
        }
        for pair in inside.windows(2).skip(1) {
            sixfold += inside[0].dot(&pair[0].cross(&pair[1]));
        }
    }
    sixfold / 6.0
}

#[test]
fn clipped_volume_of_a_cube_is_exact() {
    let corner = |i: usize| Vec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2 & 1) as f64);
    let faces = palpate_tissue::cell::FACES.map(|f| f.map(|i| i as u32));
    let cube = Surface {
        vertices: (0..8).map(corner).collect(),
        triangles: faces
            .iter()
            .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect(),
    };
    let normal = Vec3::new(1.0, 1.0, 1.0).normalize();
    // A corner of the cube is a tetrahedron with three unit edges.
    let near = Vec3::new(1.0, 0.0, 0.0);
    assert!((clipped_volume(&cube, &near, &-normal) - 1.0 / 6.0).abs() < 1e-12);
    assert!((clipped_volume(&cube, &near, &normal) - 5.0 / 6.0).abs() < 1e-12);
}

/// A plane through fat and muscle in front of the femur, from end to end and side to side.
#[test]
fn cut_right_through_a_real_thigh_gives_the_exact_parts() {
    let Some(folder) = real_models::folder() else {
        return;
    };
    let (model, _) = build(&real_models::thigh(&folder), &mut |_, _| ()).unwrap();
    let uncut = Topology::new(Arc::new(model));
    let surfaces = ["skin", "muscle"].map(|part| {
        let path = folder.join(format!("leg_bp3d/thigh_{part}.stl"));
        let mut surface = Surface::read(&path, Unit::Millimetre).unwrap();
        surface.check().unwrap();
        surface
    });
    for (y, lean, turn) in [(-0.04, 0.0, 0.0), (-0.04, 0.1, 0.05), (-0.052, -0.05, 0.03)] {
        let mut t = uncut.clone();
        let origin = Vec3::new(-0.088, y, 0.585);
        let normal = Vec3::new(lean, 1.0, turn).normalize();
        // The blade lies in the plane, across the thigh, and moves along it.
        let axis = Vec3::x() - normal * normal.x;
        let axis = axis.normalize();
        let along = axis.cross(&normal);
        let point = |s: f64| BladePoint {
            tip: origin + along * s - axis * 0.12,
            axis,
            depth_m: 0.24,
        };
        let stroke = CutStroke {
            points: (-15..=15).map(|i| point(f64::from(i) * 0.01)).collect(),
            width_m: 0.0,
        };
        let outcome = cut(&mut t, &stroke).unwrap();
        cut_laws::check_surface(&t);
        let volumes = t.component_volumes();
        assert_eq!(volumes.len(), 2, "y = {y}: {volumes:?}");
        assert_eq!(outcome.components_near, 2);
        let exact = [normal, -normal].map(|n| clipped_volume(&surfaces[0], &origin, &n));
        assert!((exact.iter().sum::<f64>() / surfaces[0].volume() - 1.0).abs() < 1e-9);
        let side = |c: u32| {
            let corners = t.corners(c).map(|n| (t.rest(n) - origin).dot(&normal));
            corners.iter().sum::<f64>() > 0.0
        };
        let cells = 0..t.cell_count() as u32;
        let front: f64 = cells
            .clone()
            .filter(|&c| side(c))
            .map(|c| t.volume(c))
            .sum();
        let muscle =
            cells.filter(|&c| side(c) && t.model().regions[t.region(c).index()].name == "muscle");
        let muscle: f64 = muscle.map(|c| t.volume(c)).sum();
        let exact_muscle = clipped_volume(&surfaces[1], &origin, &normal);
        let part = |v: f64, exact: f64| v / exact - 1.0;
        let [small, large] = [volumes[0].min(volumes[1]), volumes[0].max(volumes[1])];
        println!(
            "y = {y}: front {:.3} %, back {:.3} %, muscle in front {:.3} %, {} faces",
            100.0 * part(small, exact[0].min(exact[1])),
            100.0 * part(large, exact[0].max(exact[1])),
            100.0 * part(muscle, exact_muscle),
            outcome.faces_opened
        );
        assert!(part(small, exact[0].min(exact[1])).abs() < 0.01);
        assert!(part(large, exact[0].max(exact[1])).abs() < 0.01);
        assert!(part(muscle, exact_muscle).abs() < 0.01);
        // The pieces are the two sides of the plane.
        assert!(part(front, exact[0]).abs() < 0.01);
    }
}

/// A ball beside a wound of two crossing strokes, and on the whole thigh, each pressed in at once.
#[test]
fn wounded_real_thigh_converges() {
    let Some(folder) = real_models::folder() else {
        return;
    };
    let (model, _) = build(&real_models::thigh(&folder), &mut |_, _| ()).unwrap();
    let whole = Topology::new(Arc::new(model));
    let mut wounded = whole.clone();
    let along = incision(&whole, 0.4, 0.6, 0.025);
    let middle = along.points[along.points.len() / 2];
    let across = CutStroke {
        points: (-8..=8)
            .map(|i| BladePoint {
                tip: middle.tip + Vec3::new(4e-3 * f64::from(i), 0.0, 2e-4),
                ..middle
            })
            .collect(),
        width_m: 0.0,
    };
    for stroke in [&along, &across] {
        let outcome = cut(&mut wounded, stroke).unwrap();
        assert!(outcome.doubled.len() > 20, "{}", outcome.doubled.len());
    }
    let skin = middle.tip + middle.axis * 0.025;
    let [radius, depth] = [8e-3, 8e-3];
    let beside = skin + Vec3::new(8e-3, 0.0, 8e-3);
    for (name, topology) in [("whole", whole), ("wounded", wounded)] {
        let mut tissue = Tissue::at_rest(topology);
        let tool = Tool::ball(1, beside + middle.axis * (radius - depth), radius);
        let report = tissue.step(&[tool], Budget::new(300, 1e-6));
        println!(
            "{name}: residual {:.1e} after {} iterations",
            report.residual, report.iterations
        );
        assert!(report.residual <= 1e-6 && !report.rolled_back, "{name}");
        let force = report.reactions[0].force.norm();
        assert!(force > 0.1, "{name}: {force} N");
    }
}

/// Cells at the interface of fat and muscle are distorted, and a cut opens beside the edge.
#[test]
fn resistance_of_the_edge_is_continuous_in_a_thigh_before_and_after_a_cut() {
    let mut t = thigh();
    for depth in [9e-3, 11e-3, 13e-3] {
        let stroke = incision(&t, 0.35, 0.55, depth);
        for is_cut in [false, true] {
            if is_cut {
                cut(&mut t, &stroke).unwrap();
            }
            let shape = Shape::rest(&t);
            let history = CutHistory::new(Arc::new(t.clone()));
            let (mut track, mut last) = (EdgeTrack::default(), None::<f64>);
            for pair in stroke.points.windows(2) {
                let [a, b] = [pair[0], pair[1]];
                for i in 0..20 {
                    let share = f64::from(i) / 20.0;
                    let blade = BladePoint {
                        tip: a.tip.lerp(&b.tip, share),
                        axis: a.axis.lerp(&b.axis, share).normalize(),
                        depth_m: depth + 4e-3,
                    };
                    track.follow(&blade);
                    let force = edge_resistance(&t, &shape, &history, &blade, &mut track).newtons;
                    assert!(
                        last.is_none_or(|last| (force - last).abs() < 0.12),
                        "{last:?} {force}"
                    );
                    last = Some(force);
                }
            }
        }
    }
}

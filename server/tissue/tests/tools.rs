//! Line and surface tools on slabs and columns with known solutions.

use std::sync::Arc;

use nalgebra::UnitQuaternion;
use palpate_tissue::{
    BladePoint, Budget, ContactPatch, CutStroke, Form, Material, Reaction, Tissue, Tool, Topology,
    Vec3, block, cut,
};
use proptest::prelude::*;

const MM: f64 = 1e-3;
const D: f64 = 4.0 * MM;
const YOUNG: f64 = 10e3;

fn material() -> Material {
    Material {
        name: "test".into(),
        young_pa: YOUNG,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "test".into(),
        ..Material::default()
    }
}

struct Bench {
    tissue: Tissue,
}

impl Bench {
    fn new(cells: [usize; 3]) -> Self {
        let topology = Topology::new(Arc::new(block(cells, D, &material(), 1)));
        let tissue = Tissue::at_rest(topology);
        Self { tissue }
    }

    /// The converged reaction on one tool.
    fn press(&mut self, tool: Tool) -> Reaction {
        let budget = Budget::new(400, 1e-5);
        let report = self.tissue.step(&[tool], budget);
        assert_eq!(report.ignored_tools, 0);
        report.reactions[0].clone()
    }

    /// Pressed in from above in steps of a millimetre.
    fn lower(&mut self, tool: Tool, depth: f64) -> Reaction {
        let steps = (depth / MM).ceil() as usize;
        let mut last = None;
        for k in 1..=steps {
            let by = Vec3::z() * (-depth * k as f64 / steps as f64);
            let centre = tool.centre + by;
            last = Some(self.press(Tool { centre, ..tool }));
        }
        last.expect("a press has a step")
    }
}

/// The law holds for a middle in the plane of the surface too, which does not face it.
#[test]
fn ball_that_appears_in_tissue_has_the_force_of_one_that_was_lowered() {
    let cells = [16, 16, 10];
    let radius = 8.0 * MM;
    let at = Tool::ball(
        1,
        Vec3::new(33.0 * MM, 30.5 * MM, 10.0 * D + radius),
        radius,
    );
    for depth in [5.0 * MM, 7.9 * MM, radius, 8.1 * MM] {
        let lowered = Bench::new(cells).lower(at, depth).force;
        let centre = at.centre - Vec3::z() * depth;
        let appeared = Bench::new(cells).press(Tool { centre, ..at }).force;
        let error = (appeared - lowered).norm() / lowered.norm();
        assert!(error < 1e-3, "{depth} m: {appeared} {lowered}");
    }
}

/// A line along x through the pivot, or beside it by `offset`, whose lower side is at `z`.
fn needle(pivot: Vec3, offset: f64, half: f64, radius: f64) -> Tool {
    let mid = Vec3::x() * offset;
    Tool {
        form: Form::line(mid - Vec3::x() * half, mid + Vec3::x() * half),
        ..Tool::ball(1, pivot, radius)
    }
}

const CELLS: [usize; 3] = [16, 12, 8];
const TOP: f64 = 8.0 * D;

fn above(radius: f64) -> Vec3 {
    Vec3::new(8.0 * D, 6.0 * D, TOP + radius)
}

#[test]
fn line_of_zero_length_equals_the_ball() {
    for radius in [1.0 * MM, 6.0 * MM] {
        let at = above(radius);
        let ball = Bench::new(CELLS).lower(Tool::ball(1, at, radius), 4.0 * MM);
        let line = Bench::new(CELLS).lower(needle(at, 0.0, 1e-12, radius), 4.0 * MM);
        let miss = (ball.force - line.force).norm();
        assert!(
            miss < 1e-4 * ball.force.norm(),
            "{} {}",
            ball.force,
            line.force
        );
    }
}

#[test]
fn line_torque_is_force_times_offset() {
    for radius in [1.0 * MM, 5.0 * MM] {
        let at = above(radius);
        let centred = Bench::new(CELLS).lower(needle(at, 0.0, 10.0 * MM, radius), 4.0 * MM);
        let f = centred.force.z;
        assert!(f > 0.0 && centred.torque.xy().norm() < 1e-3 * f * 10.0 * MM);
        // The diagonals of the surface's squares all run one way, which gives a thin needle a torque in the
        // plane.
        assert!(centred.torque.z.abs() < 0.03 * f * 10.0 * MM, "{centred:?}");
        // The same needle on the same tissue, held 15 mm from its middle.
        let d = 15.0 * MM;
        let pivot = at - Vec3::x() * d;
        let offset = Bench::new(CELLS).lower(needle(pivot, d, 10.0 * MM, radius), 4.0 * MM);
        assert!((offset.force - centred.force).norm() < 1e-3 * f);
        // T = r x F with r along x and F along z.
        let miss = (offset.torque.xy() - Vec3::new(0.0, -d * f, 0.0).xy()).norm();
        assert!(miss < 0.01 * d * f, "{} N m of {}", offset.torque, d * f);
    }
}

#[test]
fn contact_points_of_a_line_sum_to_its_force_and_torque() {
    let radius = 5.0 * MM;
    let mut bench = Bench::new(CELLS);
    let tool = needle(above(radius), 6.0 * MM, 20.0 * MM, radius);
    let r = bench.lower(tool, 5.0 * MM);
    assert!(r.contact_patches.len() > 2, "{:?}", r.contact_patches);
    assert!(
        r.contact_patches
            .windows(2)
            .all(|p| p[0].number < p[1].number)
    );
    let force: Vec3 = r.contact_patches.iter().map(|p| p.force).sum();
    assert!((force - r.force).norm() < 1e-12);
    let torque: Vec3 = r
        .contact_patches
        .iter()
        .map(|p| p.lever.cross(&p.force))
        .sum();
    let lever = 26.0 * MM;
    assert!((torque - r.torque).norm() < 0.02 * lever * r.force.norm());
    for p in &r.contact_patches {
        assert!(p.pressed >= p.force.norm() - 1e-12 && p.pressed < 1.05 * p.force.norm());
        assert!(
            (p.friction_static - 0.4).abs() < 1e-12 && (p.friction_dynamic - 0.3).abs() < 1e-12
        );
        assert!((p.normal - p.force.normalize()).norm() < 1e-9);
    }
}

#[test]
fn plate_on_a_column_is_uniaxial_compression() {
    // Four times as high as wide; the foot, which cannot spread, is a small part of it.
    let cells = [6, 6, 24];
    let (side, height) = (6.0 * D, 24.0 * D);
    let mut bench = Bench::new(cells);
    let radius = 4.0 * MM;
    let plate = Tool {
        form: Form::rectangle(
            Vec3::zeros(),
            [Vec3::x() * (0.55 * side), Vec3::y() * (0.55 * side)],
        ),
        ..Tool::ball(
            1,
            Vec3::new(0.5 * side, 0.5 * side, height + radius),
            radius,
        )
    };
    let strain = 0.02;
    let r = bench.lower(plate, strain * height);
    let expected = YOUNG * strain * side * side;
    assert!(r.contact_patches.len() > 8);
    assert!(
        (r.force.z / expected - 1.0).abs() < 0.05,
        "{} of {expected}",
        r.force
    );
    assert!(r.torque.norm() < 1e-3 * expected * side);
}

#[test]
fn tilted_plate_has_a_restoring_torque() {
    let radius = 3.0 * MM;
    let at = above(radius);
    let form = Form::rectangle(
        Vec3::zeros(),
        [Vec3::x() * (12.0 * MM), Vec3::y() * (8.0 * MM)],
    );
    // Turned about y by +4 degrees: the end at +x goes down.
    let leaning = |degrees: f64| Tool {
        turn: UnitQuaternion::from_axis_angle(&Vec3::y_axis(), degrees.to_radians()),
        form,
        ..Tool::ball(1, at, radius)
    };
    let one = Bench::new(CELLS).lower(leaning(4.0), 4.0 * MM);
    let other = Bench::new(CELLS).lower(leaning(-4.0), 4.0 * MM);
    assert!(one.torque.y < -1e-4, "{}", one.torque);
    assert!((one.torque.y + other.torque.y).abs() < 0.02 * one.torque.y.abs());
    // A plate that is turned in place equals one that was lowered in the turned pose.
    let mut bench = Bench::new(CELLS);
    bench.lower(leaning(0.0), 4.0 * MM);
    let down = at - Vec3::z() * (4.0 * MM);
    let mut turned = None;
    for degree in 1..=4 {
        let tool = Tool {
            centre: down,
            ..leaning(f64::from(degree))
        };
        turned = Some(bench.press(tool));
    }
    let turned = turned.unwrap();
    assert!((turned.force - one.force).norm() < 0.01 * one.force.norm());
    assert!((turned.torque - one.torque).norm() < 0.03 * one.torque.norm());
}

#[test]
fn blade_edge_force_is_larger_at_the_deeper_end() {
    // 30 mm long, 10 mm high, 1 mm thick: far thinner than the lattice.
    let radius = 0.5 * MM;
    let half = [Vec3::x() * (15.0 * MM), Vec3::z() * (5.0 * MM)];
    let mut bench = Bench::new(CELLS);
    let at = Vec3::new(8.0 * D, 6.0 * D + 0.3 * MM, TOP + radius + 5.0 * MM);
    let tool = Tool {
        turn: UnitQuaternion::from_axis_angle(&Vec3::y_axis(), 0.1),
        form: Form::rectangle(Vec3::zeros(), half),
        ..Tool::ball(1, at, radius)
    };
    let r = bench.lower(tool, 3.0 * MM);
    assert!(
        r.force.z > 0.0 && r.force.xy().norm() < 0.2 * r.force.z,
        "{}",
        r.force
    );
    // The end at +x is the lower one, so the torque turns it up: about -y.
    assert!(r.torque.y < 0.0, "{}", r.torque);
}

#[test]
fn long_tool_swinging_in_stops_at_the_surface() {
    let radius = 3.0 * MM;
    let mut bench = Bench::new(CELLS);
    // Its pivot stays beside the slab; the needle reaches over it and swings down.
    let pivot = Vec3::new(-10.0 * MM, 6.0 * D, TOP + 8.0 * MM);
    let swing = |angle: f64| Tool {
        turn: UnitQuaternion::from_axis_angle(&Vec3::y_axis(), angle),
        form: Form::line(Vec3::zeros(), Vec3::x() * (40.0 * MM)),
        ..Tool::ball(1, pivot, radius)
    };
    assert_eq!(bench.press(swing(-0.2)).contacts, 0);
    // One step of about a quarter turn: the tip would be 12 mm deep.
    let r = bench.press(swing(0.35));
    assert!(r.force.z > 0.0 && r.contacts > 0, "{r:?}");
    let mut slow = Bench::new(CELLS);
    let mut s = slow.press(swing(-0.2));
    for k in 1..=22 {
        s = slow.press(swing(-0.2 + 0.025 * f64::from(k)));
    }
    assert!(
        (s.force - r.force).norm() < 0.05 * s.force.norm(),
        "{} {}",
        r.force,
        s.force
    );
}

#[test]
fn invalid_tool_forms_are_ignored_and_counted() {
    let mut bench = Bench::new([4, 4, 4]);
    let ball = Tool::ball(1, Vec3::new(8.0 * MM, 8.0 * MM, 17.0 * MM), 2.0 * MM);
    let nan = Vec3::new(f64::NAN, 0.0, 0.0);
    let bad = [
        Form::line(Vec3::zeros(), nan),
        Form::line(Vec3::zeros(), Vec3::x() * 1e9),
        Form::rectangle(nan, [Vec3::zeros(); 2]),
        // Not a rectangle.
        Form::rectangle(Vec3::zeros(), [Vec3::x(), Vec3::new(0.5, 0.5, 0.0)]),
    ];
    for form in bad {
        let tool = Tool { form, ..ball };
        assert!(!tool.is_sound());
        let report = bench.tissue.step(&[tool], Budget::new(3, 1e-3));
        assert_eq!((report.ignored_tools, report.reactions.len()), (1, 0));
    }
}

#[test]
fn tool_larger_than_the_model_presses_all_of_it() {
    let mut bench = Bench::new([4, 4, 4]);
    let radius = 4.0 * MM;
    let plate = Tool {
        form: Form::rectangle(Vec3::zeros(), [Vec3::x() * 0.8, Vec3::y() * 0.8]),
        ..Tool::ball(1, Vec3::new(8.0 * MM, 8.0 * MM, 16.0 * MM + radius), radius)
    };
    let r = bench.lower(plate, 1.0 * MM);
    // Slightly more than a free column of its size, because its foot is held.
    let free = YOUNG * (1.0 / 16.0) * (16.0 * MM) * (16.0 * MM);
    assert!(
        (0.95..1.4).contains(&(r.force.z / free)),
        "{} of {free}",
        r.force
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, failure_persistence: None, ..Default::default() })]

    /// A tool is pushed out by no more than its press: no tool is pulled in, and a press and release yields no
    /// energy.
    #[test]
    fn no_tool_is_pulled_in(
        long in 0.0..0.02f64, broad in 0.0..0.012f64, radius in 0.3e-3..6e-3f64, lean in -0.3..0.3f64, turn in -3.0..3.0f64,
    ) {
        let q = UnitQuaternion::from_axis_angle(&Vec3::y_axis(), lean)
            * UnitQuaternion::from_axis_angle(&Vec3::z_axis(), turn);
        let form = Form::rectangle(Vec3::zeros(), [Vec3::x() * long, Vec3::y() * broad]);
        // Its lowest corner is at the surface, so that every tool touches.
        let down = long * (q * Vec3::x()).z.abs() + broad * (q * Vec3::y()).z.abs();
        let tool = Tool { turn: q, form, ..Tool::ball(1, above(radius + down), radius) };
        let mut bench = Bench::new(CELLS);
        let mut most = 0.0_f64;
        let mut work = 0.0;
        let mut last: Option<f64> = None;
        for k in 0..=12 {
            let depth = 0.5 * MM * f64::from(k.min(12 - k));
            let by = Vec3::z() * -depth;
            let r = bench.press(Tool { centre: tool.centre + by, ..tool });
            prop_assert!(r.force.z > -1e-6, "{}", r.force);
            most = most.max(r.force.z);
            if let Some(before) = last {
                let step = if k <= 6 { 0.5 * MM } else { -0.5 * MM };
                work += 0.5 * (before + r.force.z) * step;
            }
            last = Some(r.force.z);
        }
        prop_assert!(most > 0.0);
        prop_assert!(work > -0.02 * most * 3.0 * MM, "{work} J of {}", most * 3.0 * MM);
    }
}

#[test]
fn four_times_the_samples_change_force_by_less_than_2_percent() {
    // At three spacings a triangle has one sample, below that four.
    let press = |radius: f64| {
        let mut bench = Bench::new(CELLS);
        bench.lower(needle(above(radius), 0.0, 12.0 * MM, radius), 5.0 * MM)
    };
    let (few, many) = (press(3.001 * D), press(2.999 * D));
    assert!(
        many.contacts > 3 * few.contacts,
        "{} {}",
        many.contacts,
        few.contacts
    );
    let change = few.force.norm() / many.force.norm() - 1.0;
    assert!(change.abs() < 0.02, "{change}");
}

#[test]
fn ball_force_decreases_from_face_to_edge_to_corner() {
    let radius = 6.0 * MM;
    let push = |at: Vec3, along: Vec3| {
        let mut bench = Bench::new(CELLS);
        let (out, mut last) = (along.normalize(), None);
        for k in 1..=4 {
            let centre = at + out * (radius - MM * f64::from(k));
            last = Some(bench.press(Tool::ball(1, centre, radius)));
        }
        let r = last.expect("four steps");
        let aside = r.force - out * r.force.dot(&out);
        assert!(aside.norm() < 0.25 * r.force.norm(), "{along}: {}", r.force);
        assert!(r.contact_patches.len() == 1 && r.torque.norm() < radius * r.force.norm());
        r.force.dot(&out)
    };
    let [x, y, z] = [0, 1, 2].map(|i| CELLS[i] as f64 * D);
    let face = push(Vec3::new(0.5 * x, 0.5 * y, z), Vec3::z());
    let edge = push(Vec3::new(x, 0.5 * y, z), Vec3::new(1.0, 0.0, 1.0));
    let corner = push(Vec3::new(x, y, z), Vec3::new(1.0, 1.0, 1.0));
    assert!(
        face > edge && edge > corner && corner > 0.0,
        "{face} {edge} {corner}"
    );
}

/// Fig. 4.14: friction in a wound is summed over the layers around the tool, each with its own friction.
#[test]
fn blade_in_a_wound_has_the_friction_of_each_layer() {
    let mut model = block([14, 14, 9], D, &material(), 1);
    let mut upper = model.regions[1].clone();
    upper.name = "upper".into();
    upper.material.young_pa = 3.0 * YOUNG;
    (
        upper.material.friction_static,
        upper.material.friction_dynamic,
    ) = (0.2, 0.1);
    model.regions.push(upper);
    for cell in &mut model.cells {
        let z = cell
            .corners
            .map(|n| model.nodes[n as usize].z)
            .iter()
            .sum::<f64>()
            / 8.0;
        if z > 6.0 * D {
            cell.region = palpate_tissue::RegionId(2);
        }
    }
    let mut topology = Topology::new(Arc::new(model));
    let top = 9.0 * D;
    let point = |x: f64| BladePoint {
        tip: Vec3::new(x, 7.0 * D, top - 6.0 * D),
        axis: Vec3::z(),
        depth_m: 6.0 * D + 0.01,
    };
    let stroke = CutStroke {
        points: vec![point(-0.01), point(14.0 * D + 0.01)],
        width_m: 0.0,
    };
    cut(&mut topology, &stroke).expect("a cut right through");
    let tissue = Tissue::at_rest(topology);
    let mut bench = Bench { tissue };
    // A plate on edge, 3 mm thick, lowered into the wound; half of it in each layer.
    let (radius, half) = (1.5 * MM, 9.0 * MM);
    let tool = |depth: f64| Tool {
        form: Form::rectangle(Vec3::z() * half, [Vec3::z() * half, Vec3::x() * (8.0 * MM)]),
        ..Tool::ball(1, Vec3::new(7.0 * D, 7.0 * D, top + radius - depth), radius)
    };
    let mut last = None;
    for k in 1..=36 {
        last = Some(bench.press(tool(0.5 * MM * f64::from(k))));
    }
    let r = last.expect("steps");
    let pressed: f64 = r.contact_patches.iter().map(|p| p.pressed).sum();
    // The contact points at the tip lie mostly in the lower layer, the others in the upper one.
    let (deep, high): (Vec<&ContactPatch>, Vec<&ContactPatch>) = r
        .contact_patches
        .iter()
        .partition(|p| p.friction_static > 0.3);
    assert!(
        !deep.is_empty() && !high.is_empty(),
        "{:#?}",
        r.contact_patches
    );
    for p in &high {
        assert!((p.friction_static - 0.2).abs() < 1e-9 && (p.friction_dynamic - 0.1).abs() < 1e-9);
    }
    for p in &r.contact_patches {
        // Both sides press across the wound, so the net force is zero.
        assert!(
            p.pressed > 3.0 * p.force.xy().norm() && p.normal.y.abs() > 0.8,
            "{p:?}"
        );
    }
    assert!(pressed > 3.0 * r.force.norm(), "{pressed} {}", r.force);
}

#[test]
fn ball_turning_in_place_reports_its_rotation() {
    let mut bench = Bench::new(CELLS);
    let ball = Tool::ball(1, above(8.0 * MM) - Vec3::z() * (4.0 * MM), 8.0 * MM);
    bench.press(ball);
    let turn = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), 1.2);
    let turned = bench.press(Tool { turn, ..ball });
    assert!(turned.turn.angle_to(&turn) < 1e-12 && turned.force.z > 0.0);
}

#[test]
fn closing_jaw_meets_the_wall_from_outside() {
    // A wall 24 mm thick with the jaw beside it; the closed form then lies 6 mm deeper, past the surface.
    let mut bench = Bench::new([6, 10, 8]);
    let radius = 2.0 * MM;
    let jaw = |x: f64| Tool {
        form: Form::rectangle(
            Vec3::x() * x,
            [Vec3::z() * (8.0 * MM), Vec3::y() * (5.0 * MM)],
        ),
        ..Tool::ball(
            1,
            Vec3::new(24.0 * MM + 8.0 * MM, 20.0 * MM, 22.0 * MM),
            radius,
        )
    };
    assert_eq!(bench.press(jaw(0.0)).contacts, 0);
    let mut closed = bench.press(jaw(-12.0 * MM));
    for _ in 0..10 {
        closed = bench.press(jaw(-12.0 * MM));
    }
    // Pushed back out, along +x.
    assert!(closed.force.x > 0.0 && closed.contacts > 0, "{closed:?}");
}

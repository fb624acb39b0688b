//! Tools on paths through tissue and through what holds it.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::UnitQuaternion;
use palpate_tissue::{Budget, Form, Material, Tissue, Tool, Topology, Vec3, block};
use proptest::prelude::*;

const SPACING: f64 = 4e-3;
const CELLS: [usize; 3] = [10, 10, 6];
const TOP: f64 = 6.0 * SPACING;
/// Way of a hand of 250 mm/s in one solve of 4 ms.
const STEP_M: f64 = 1e-3;

type Pose = (Vec3, UnitQuaternion<f64>);

/// Soft tissue on a floor that does not yield.
fn tissue() -> Tissue {
    Tissue::at_rest(Topology::new(Arc::new(block(
        CELLS,
        SPACING,
        &Material::default(),
        1,
    ))))
}

/// The budget of a hand.
fn quick() -> Budget<'static> {
    Budget {
        near: true,
        ..Budget::new(4, 2e-2)
    }
}

/// Moves a tool in quick steps, at once or at the speed of a hand.
fn lead(tissue: &mut Tissue, tool: &mut Tool, to: Pose, jumps: bool) {
    let way = (to.0 - tool.centre).norm() + 0.01 * to.1.angle_to(&tool.turn);
    let steps = if jumps {
        1.0
    } else {
        (way / STEP_M).ceil().max(1.0)
    };
    let from = (tool.centre, tool.turn);
    for k in 1..=steps as usize {
        let share = k as f64 / steps;
        tool.centre = from.0 + (to.0 - from.0) * share;
        tool.turn = from.1.try_slerp(&to.1, share, 1e-9).unwrap_or(to.1);
        tissue.step(&[*tool], quick());
    }
}

fn pose() -> impl Strategy<Value = Pose> {
    let place = [-10e-3..50e-3, -10e-3..50e-3, -10e-3..35e-3];
    let turn = [-PI..PI, -1.5..1.5, -PI..PI];
    (place, turn).prop_map(|([x, y, z], [roll, pitch, yaw])| {
        let turn = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        (Vec3::new(x, y, z), turn)
    })
}

fn tool() -> impl Strategy<Value = Tool> {
    let line = Form::line(Vec3::x() * -10e-3, Vec3::x() * 10e-3);
    let plate = Form::rectangle(Vec3::zeros(), [Vec3::x() * 8e-3, Vec3::y() * 8e-3]);
    let forms = [None, Some(line), Some(plate)];
    (prop::sample::select(forms.to_vec()), 1e-3..6e-3).prop_map(|(form, radius)| {
        let ball = Tool::ball(1, Vec3::new(20e-3, 20e-3, TOP + 1.5 * radius), radius);
        let form = form.unwrap_or(ball.form);
        Tool { form, ..ball }
    })
}

/// A ball that passed through the surface would move inside the tissue without force.
#[test]
fn ball_that_is_pushed_deep_stays_in_contact() {
    let fat = Material::built_in("fat").unwrap();
    let topology = Topology::new(Arc::new(block([12, 12, 12], SPACING, &fat, 1)));
    for (radius, x) in [
        (2e-3, 24.0e-3),
        (3e-3, 25.3e-3),
        (3e-3, 22.6e-3),
        (6e-3, 24.4e-3),
    ] {
        let mut tissue = Tissue::at_rest(topology.clone());
        let mut without = 0;
        for k in 1..=100 {
            let depth = 4e-4 * f64::from(k);
            let at = Vec3::new(x, 23.1e-3, 12.0 * SPACING + radius - depth);
            let force = tissue.step(&[Tool::ball(1, at, radius)], quick()).reactions[0].force;
            without += usize::from(force.norm() < 1e-3);
        }
        assert!(
            without <= 2,
            "{radius} m at {x} m: {without} steps without force"
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn tool_is_free_outside_and_presses_as_a_new_one_whatever_it_passed_through(
        tool in tool(),
        path in prop::collection::vec((pose(), 0..6_usize), 1..7),
        jumps in any::<bool>(),
        [x, y] in [12e-3..28e-3, 12e-3..28e-3_f64],
    ) {
        let mut tissue = tissue();
        let mut led = tool;
        for (to, rests) in path {
            lead(&mut tissue, &mut led, to, jumps);
            for _ in 0..rests {
                tissue.step(&[led], quick());
            }
        }
        let above = |radii: f64| {
            let at = Vec3::new(x, y, TOP + radii * tool.radius_m);
            (at, UnitQuaternion::identity())
        };
        let settled = |tissue: &mut Tissue, led: &Tool| {
            for _ in 0..100 {
                tissue.step(&[*led], quick());
            }
            tissue.step(&[*led], quick()).reactions[0].clone()
        };
        lead(&mut tissue, &mut led, above(1.3), jumps);
        let free = settled(&mut tissue, &led);
        prop_assert!((free.at - led.centre).norm() < 1e-9, "at {} of {}", free.at, led.centre);
        // Quick steps leave what is below their tolerance.
        prop_assert!(free.force.norm() < 5e-3, "{} N", free.force);

        lead(&mut tissue, &mut led, above(0.6), jumps);
        let pressed = settled(&mut tissue, &led).force;
        let mut fresh = self::tissue();
        let expected = fresh.step(&[led], Budget::new(300, 1e-5)).reactions[0].force;
        let error = (pressed - expected).norm() / expected.norm();
        prop_assert!(error < 0.05, "{pressed} instead of {expected}");
    }
}

use nalgebra::UnitQuaternion;
use palpate_device::{DeviceTime, Pose, Sample};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Tick};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ClientTime, ParticipantId, ServerTime};
use palpate_tissue::{Budget, Vec3};

use super::*;
use crate::test_support::{caps, soft_block};

const CELL: f64 = 4e-3;
const RADIUS: f64 = 6e-3;

/// Maximum depth of the drawn surface inside the tool at the proxy, m.
const WITHIN_M: f64 = 1e-3;

fn tool(depth: f64) -> ToolAt {
    ToolAt {
        participant: ParticipantId(1),
        description: ToolDescription::probe(RADIUS),
        position: Vec3::new(5.1 * CELL, 4.9 * CELL, 6.0 * CELL + RADIUS - depth),
        orientation: UnitQuaternion::identity(),
        buttons: 0,
        strength: 1.0,
        returns: false,
        predicted: None,
    }
}

/// The last tick of a hand that holds the tool for two seconds.
fn held(own: &ToolAt, model: &ContactModel) -> Tick {
    let mut chain = Chain::new(ChainConfig::default(), &caps());
    let sample = Sample::resting(DeviceTime::ZERO, Pose::at(own.position));
    let tick = |ms: i64| {
        let now = ClientTime::from_micros(1000 * ms);
        let model = ContactModel {
            solved_at: now,
            ..*model
        };
        chain.tick(now, &sample, &model)
    };
    (1..2000).map(tick).last().unwrap()
}

/// Maximum depth of the drawn surface inside the ball at `middle`, m; negative outside.
fn overlap(replica: &Replica, middle: Vec3) -> f64 {
    const PARTS: usize = 10;
    let topology = replica.topology();
    let displacement = &replica.view().unwrap().shape().displacement;
    let nearest = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|n| topology.rest(n) + displacement[n as usize]);
        let mut least = f64::INFINITY;
        for i in 0..=PARTS {
            for j in 0..=PARTS - i {
                let [u, v] = [i, j].map(|k| k as f64 / PARTS as f64);
                let at = a + (b - a) * u + (c - a) * v;
                least = least.min((at - middle).norm());
            }
        }
        least
    };
    let triangles = &topology.boundary().triangles;
    RADIUS - triangles.iter().map(nearest).fold(f64::INFINITY, f64::min)
}

#[test]
fn proxy_of_a_press_stays_on_or_outside_the_drawn_surface() {
    let mut replica = Replica::new(soft_block([10, 10, 6]), true);
    for (k, depth) in (0..).zip([-1.0e-3, 1.0e-3, 2.0e-3, 4.0e-3, 6.0e-3]) {
        let own = tool(depth);
        let thorough = || Budget::new(200, 1e-5);
        let model = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
        let view = replica.view_mut().unwrap();
        view.step(ServerTime::from_micros(4000 * k), &[own], thorough());
        let tick = held(&own, &model);
        let pressed_m = tick.proxy_offset.norm();
        assert_eq!(pressed_m > 0.0, depth > 0.0, "{tick:?}");
        let inside_m = overlap(&replica, own.position + tick.proxy_offset);
        let depth_mm = 1e3 * depth;
        assert!(
            inside_m < WITHIN_M,
            "{depth_mm} mm: the surface is {inside_m} m inside the tool at the proxy"
        );
        // The proxy is near the surface at rest, because soft tissue presses back in proportion to its depth.
        assert!(
            (pressed_m - depth.max(0.0)).abs() < 0.25 * depth.abs(),
            "{depth_mm} mm: the proxy is {pressed_m} m away"
        );
    }
}

/// The block is 24 mm thick, on a floor that does not yield, and the tool stays in it. Above 10 N devices saturate. The greatest force
/// is that of medians of three: on tissue pressed flat, single solves have a third more force.
#[test]
fn force_never_drops_while_a_tool_is_pushed_deeper() {
    let mut replica = Replica::new(soft_block([10, 10, 6]), true);
    let (mut last, mut greatest) = ([0.0; 3], 0.0_f64);
    for half_mm in 1..=64 {
        let own = tool(0.5e-3 * f64::from(half_mm));
        let mut never = || false;
        let budget = hand_budget(&mut never);
        let model = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], budget);
        last = [last[1], last[2], held(&own, &model).felt.force.norm()];
        let mut sorted = last;
        sorted.sort_by(f64::total_cmp);
        assert!(
            last[2] > 0.9 * greatest.min(10.0),
            "{} mm: {last:?} N after {greatest} N",
            0.5 * f64::from(half_mm)
        );
        greatest = greatest.max(sorted[1]);
    }
}

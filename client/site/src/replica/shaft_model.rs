//! Contact points of an inserted needle.
//!
//! The tissue holds the shaft from all sides. For the force loop that is one contact point along the needle, which can pull
//! with the friction on the shaft, and two across it at the tip and two where it enters. Their friction is zero, because the
//! solver computes it together with the tissue that it drags along.

use palpate_haptics::{ContactModel, Touch};
use palpate_tissue::{Reaction, ShaftReaction, Vec3};

use super::contact_model::{DAMPING_MAX_NS_PER_M, DAMPING_S, MODEL_RADIUS_M};

/// Force across the shaft that either side can carry, N: more than any device renders.
const HELD_N: f64 = 100.0;
/// Contact points, which share the damping.
const POINTS: f64 = 5.0;

/// Replaces the contact points of a model by those of an inserted needle.
pub(super) fn hold_shaft(model: &mut ContactModel, reaction: &Reaction, shaft: &ShaftReaction) {
    model.x0 = reaction.at;
    model.turn0 = reaction.turn;
    model.radius = MODEL_RADIUS_M;
    // The contact points carry the whole torque.
    model.couple = Vec3::zeros();
    let touch = |lever: Vec3, normal: Vec3, newtons: f64, share: f64, pull_n: f64| {
        let along = share * normal.dot(&(reaction.stiffness * normal)).max(0.0);
        Touch {
            touches: true,
            lever,
            f0: normal * newtons,
            stiffness: normal * normal.transpose() * along,
            damping: (DAMPING_S * along).min(DAMPING_MAX_NS_PER_M / POINTS),
            normal,
            pressed_n: newtons.abs() + pull_n,
            ..Touch::NONE
        }
    };
    let first = shaft.axis.cross(&least_axis(&shaft.axis)).normalize();
    let across = [first, shaft.axis.cross(&first)];
    model.touches[0] = touch(shaft.tip, shaft.axis, shaft.axial_n, 1.0, shaft.friction_n);
    let stations = shaft.stations.iter();
    let pairs = stations.flat_map(|&(lever, force)| across.map(|normal| (lever, force, normal)));
    for (slot, (lever, force, normal)) in model.touches[1..].iter_mut().zip(pairs) {
        *slot = touch(lever, normal, normal.dot(&force), 0.5, HELD_N);
    }
}

/// The axis of the scene that is farthest from a direction.
fn least_axis(direction: &Vec3) -> Vec3 {
    let mut axis = Vec3::zeros();
    axis[direction.iamin()] = 1.0;
    axis
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Matrix3, UnitQuaternion, Vector3};
    use palpate_device::{DeviceTime, Pose, Sample};
    use palpate_haptics::{Chain, ChainConfig};
    use palpate_protocol::tool::{INSERTED_BUTTON, ToolDescription, ToolKind};
    use palpate_protocol::{ClientTime, ParticipantId, ServerTime};
    use palpate_tissue::{Budget, Model};
    use proptest::prelude::*;

    use super::*;
    use crate::replica::Replica;
    use crate::replica::contact_model::contact_model;
    use crate::test_support::{caps, soft_block};
    use crate::tools::ToolAt;
    use crate::{VIEW_ITERATIONS, VIEW_TOLERANCE};

    const CELL_M: f64 = 4e-3;
    const RADIUS_M: f64 = 0.6e-3;
    const TOUGHNESS_J_M2: f64 = 200.0;
    const CUTTING_N: f64 = TOUGHNESS_J_M2 * 2.0 * RADIUS_M;

    fn vector(size: f64) -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-size..size).prop_map(Vec3::from)
    }

    proptest! {
        /// Force and torque of the solver are preserved.
        #[test]
        fn shaft_model_preserves_force_and_torque(
            axis in vector(1.0), axial_n in -2.0..2.0f64, levers in prop::array::uniform3(vector(0.1)),
            forces in prop::array::uniform2(vector(2.0)),
        ) {
            prop_assume!(axis.norm() > 0.1);
            let axis = axis.normalize();
            let across = forces.map(|f| f - axis * f.dot(&axis));
            let stations = [(levers[1], across[0]), (levers[2], across[1])];
            let shaft = ShaftReaction { tip: levers[0], axis, axial_n, friction_n: 0.5, stations };
            let force = axis * axial_n + across[0] + across[1];
            let torque = shaft.tip.cross(&(axis * axial_n))
                + stations.iter().map(|(lever, f)| lever.cross(f)).sum::<Vec3>();
            let reaction = Reaction {
                tool: 2,
                force,
                torque,
                stiffness: Matrix3::from_diagonal_element(300.0),
                normal: axis,
                contacts: 3,
                friction_static: 0.0,
                friction_dynamic: 0.0,
                force_error: 0.0,
                at: Vec3::new(0.1, 0.2, 0.3),
                lag_m: 0.0,
                turn: UnitQuaternion::identity(),
                contact_patches: Vec::new(),
                shaft: Some(shaft),
                is_inserted: true,
            };
            let mut model = contact_model(ClientTime::ZERO, 1, &[&reaction]);
            hold_shaft(&mut model, &reaction, &shaft);
            prop_assert!(model.is_usable());
            prop_assert!((model.force() - force).norm() < 1e-9);
            prop_assert!((model.torque() - torque).norm() < 1e-9);
            prop_assert!(model.touching().map(|t| t.damping).sum::<f64>() <= DAMPING_MAX_NS_PER_M + 1e-9);
        }
    }

    fn tissue() -> Arc<Model> {
        let mut model = Arc::unwrap_or_clone(soft_block([12, 10, 8]));
        for region in &mut model.regions {
            region.material.toughness_j_m2 = TOUGHNESS_J_M2;
        }
        Arc::new(model)
    }

    /// A needle in a hand, with the view of another site.
    struct Bench {
        replica: Replica,
        other: Replica,
        chain: Chain,
        model: ContactModel,
        tool: ToolAt,
        ms: i64,
        last: Vec3,
        /// Largest change of the force in a tick, N.
        jump_n: f64,
        /// Work of the hand, J.
        work_j: f64,
    }

    impl Bench {
        fn new() -> Self {
            let description = ToolDescription {
                kind: ToolKind::Needle,
                length_m: 0.06,
                ..ToolDescription::probe(RADIUS_M)
            };
            Self {
                replica: Replica::new(tissue(), true),
                other: Replica::new(tissue(), false),
                chain: Chain::new(ChainConfig::default(), &caps()),
                model: ContactModel::FREE,
                tool: ToolAt {
                    participant: ParticipantId(1),
                    description,
                    position: Vec3::new(6.1 * CELL_M, 5.0 * CELL_M, 8.0 * CELL_M + 3e-3),
                    orientation: UnitQuaternion::identity(),
                    buttons: 0,
                    strength: 1.0,
                    returns: false,
                    predicted: None,
                },
                ms: 0,
                last: Vec3::zeros(),
                jump_n: 0.0,
                work_j: 0.0,
            }
        }

        fn depth_m(&self) -> f64 {
            8.0 * CELL_M - self.tool.position.z
        }

        /// Moves the needle by a velocity in m/s; returns depths and forces along the shaft.
        fn go(&mut self, velocity: Vec3, ms: i64) -> Vec<(f64, f64)> {
            let mut forces = Vec::new();
            for _ in 0..ms {
                let now = ClientTime::from_micros(1000 * self.ms);
                self.tool.position += velocity * 1e-3;
                if self.ms % 4 == 0 {
                    let budget = Budget {
                        near: true,
                        ..Budget::new(4, 2e-2)
                    };
                    self.model = self.replica.haptic_step(now, Some(&self.tool), &[], budget);
                    self.tool.buttons = if self.model.is_inserted {
                        INSERTED_BUTTON
                    } else {
                        0
                    };
                }
                if self.ms % 32 == 0 {
                    let s = ServerTime::from_micros(1000 * self.ms);
                    let budget = Budget::new(VIEW_ITERATIONS, VIEW_TOLERANCE);
                    self.other.view_mut().unwrap().step(s, &[self.tool], budget);
                }
                let sample = Sample {
                    velocity: Vector3::from(velocity),
                    ..Sample::resting(
                        DeviceTime::from_micros(1000 * self.ms),
                        Pose::at(self.tool.position),
                    )
                };
                let force = self.chain.tick(now, &sample, &self.model).wrench.force;
                self.jump_n = self.jump_n.max((force - self.last).norm());
                self.work_j -= 0.5 * (force + self.last).dot(&velocity) * 1e-3;
                self.last = force;
                self.ms += 1;
                forces.push((self.depth_m(), force.z));
            }
            forces
        }
    }

    #[test]
    fn rendered_force_of_a_needle_rises_to_the_puncture_and_turns_around_with_the_hand() {
        let mut bench = Bench::new();
        // The chain starts softly.
        bench.go(Vec3::zeros(), 1200);
        let speed = Vec3::z() * 0.02;
        let into = bench.go(-speed, 1100);
        let peak = into.iter().map(|f| f.1).fold(0.0, f64::max);
        assert!(bench.model.is_inserted);
        // The tip, and friction on 18 mm of the shaft.
        assert!((1.3..1.8).contains(&(peak / CUTTING_N)), "{peak}");
        bench.go(Vec3::zeros(), 400);
        let apart = apart_m(&bench);
        assert!(apart < 0.5e-3, "{apart}");
        let out = bench.go(speed, 1300);
        let pull = out.iter().map(|f| f.1).fold(0.0, f64::min);
        assert!(pull < 0.0 && pull > -peak, "{pull}");
        assert!(
            !bench.model.is_inserted && bench.last == Vec3::zeros(),
            "{}",
            bench.last
        );
        assert!(
            bench.jump_n <= bench.chain.slew_step_n() + 1e-9,
            "{}",
            bench.jump_n
        );
        assert!(bench.work_j > CUTTING_N * 10e-3, "{}", bench.work_j);
        bench.go(Vec3::zeros(), 200);
        assert!(apart_m(&bench) < 0.1e-3);
    }

    #[test]
    fn needle_that_is_held_sideways_is_pushed_back_without_oscillation() {
        let mut bench = Bench::new();
        bench.go(Vec3::zeros(), 1200);
        bench.go(Vec3::z() * -0.02, 1100);
        bench.go(Vec3::x() * 0.01, 200);
        let held = bench.last;
        assert!(held.x < -0.1, "{held}");
        bench.jump_n = 0.0;
        bench.go(Vec3::zeros(), 300);
        assert!(
            (bench.last.x - held.x).abs() < 0.1 * held.x.abs(),
            "{} {held}",
            bench.last
        );
        assert!(bench.jump_n < 0.02, "{}", bench.jump_n);
    }

    /// Largest distance of a node between the shape of the hand and the view of the other site, m.
    fn apart_m(bench: &Bench) -> f64 {
        let hand = bench.replica.haptic_shape().unwrap();
        let view = bench.other.view().unwrap().shape();
        let pairs = hand.displacement.iter().zip(&view.displacement);
        pairs.map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
    }
}

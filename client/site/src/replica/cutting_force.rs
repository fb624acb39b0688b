//! Contact point of a cutting blade.
//!
//! The tissue holds the edge back with the force of [`edge_resistance`] against any motion across the edge. For the force
//! loop that is one contact point that the tissue squeezes from all sides across the edge: no normal force, and dry friction
//! with the resistance as its limit (both coefficients are one). Its tie is the tissue before the edge, which yields by
//! [`YIELD_M`] before it parts. One point for the whole edge, because layers pass along the edge of a blade that goes deeper,
//! and each new point would begin without stretch.

use std::collections::BTreeMap;

use palpate_haptics::{ContactModel, Touch};
use palpate_protocol::ParticipantId;
use palpate_tissue::{BladePoint, EdgeTrack, Tissue, Vec3, edge_resistance};

use super::contact_model::MODEL_RADIUS_M;
use crate::tools::ToolAt;

/// How far the edge pushes tissue before it parts, m. A shorter way makes a stiffer tie, which devices limit.
const YIELD_M: f64 = 1e-3;

/// The resistance against the edge of the own blade. A replica may serve several hands in turn.
#[derive(Debug, Default)]
pub(super) struct CuttingForce {
    tracks: BTreeMap<ParticipantId, EdgeTrack>,
}

impl CuttingForce {
    /// Adds the resistance of the tissue against a tool that cuts to the model of its contacts.
    pub(super) fn add_to(&mut self, model: &mut ContactModel, tissue: &Tissue, tool: &ToolAt) {
        let Some(blade) = tool.edge() else {
            // The next cut begins elsewhere, in another direction.
            self.tracks.remove(&tool.participant);
            return;
        };
        let (topology, shape, history) = (tissue.topology(), tissue.shape(), tissue.history());
        let track = self.tracks.entry(tool.participant).or_default();
        // A predicted tip may move backwards while the hand brakes.
        track.follow(&blade);
        let solved = tool.solved_pose();
        let blade = BladePoint {
            tip: solved.position,
            axis: solved.orientation * Vec3::z(),
            ..blade
        };
        let edge = edge_resistance(topology, shape, history, &blade, track);
        if edge.newtons <= 0.0 {
            return;
        }
        model.x0 = solved.position;
        model.turn0 = solved.orientation;
        model.radius = MODEL_RADIUS_M;
        model.touches[0] = Touch {
            touches: true,
            lever: blade.axis * edge.along_m,
            tangential_stiffness: edge.newtons / YIELD_M,
            normal: blade.axis,
            pressed_n: edge.newtons,
            mu_static: 1.0,
            mu_dynamic: 1.0,
            ..Touch::NONE
        };
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{UnitQuaternion, Vector3};
    use palpate_device::{Buttons, DeviceTime, Pose, Sample};
    use palpate_haptics::{Chain, ChainConfig, Tick};
    use palpate_protocol::ClientTime;
    use palpate_protocol::tool::ToolDescription;
    use palpate_tissue::{Budget, CutStroke, Model};
    use proptest::prelude::*;

    use super::*;
    use crate::replica::Replica;
    use crate::test_support::{caps, soft_block};

    const CELL_M: f64 = 4e-3;
    const TOUGHNESS_J_M2: f64 = 150.0;

    fn tissue() -> Arc<Model> {
        let mut model = Arc::unwrap_or_clone(soft_block([12, 10, 6]));
        for region in &mut model.regions {
            region.material.toughness_j_m2 = TOUGHNESS_J_M2;
        }
        Arc::new(model)
    }

    /// The last tick of a blade that is drawn by `velocity` (m/s) through the middle of the block for 0.3 s, its tip at
    /// `depth_m` and its button held.
    fn drawn(depth_m: f64, velocity: Vec3) -> Tick {
        let mut replica = Replica::new(tissue(), true);
        let mut chain = Chain::new(ChainConfig::default(), &caps());
        let begin = Vec3::new(6.1 * CELL_M, 5.0 * CELL_M, 6.0 * CELL_M - depth_m) - velocity * 0.2;
        let mut model = ContactModel::FREE;
        let mut tick = None;
        for ms in 0..1500_i64 {
            let now = ClientTime::from_micros(1000 * ms);
            // The chain starts softly.
            let moved_s = (ms - 1200).max(0) as f64 * 1e-3;
            let tool = ToolAt {
                participant: ParticipantId(1),
                description: ToolDescription::scalpel(6e-3, 0.02),
                position: begin + velocity * moved_s,
                orientation: UnitQuaternion::identity(),
                buttons: 1,
                strength: 1.0,
                returns: false,
                predicted: None,
            };
            if ms % 4 == 0 {
                model = replica.haptic_step(now, Some(&tool), &[], Budget::new(4, 1e-2));
            }
            let sample = Sample {
                buttons: Buttons::PRIMARY,
                velocity: if moved_s > 0.0 {
                    velocity
                } else {
                    Vector3::zeros()
                },
                ..Sample::resting(DeviceTime::from_micros(1000 * ms), Pose::at(tool.position))
            };
            tick = Some(chain.tick(now, &sample, &model));
        }
        tick.unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]
        /// Across the edge, the force against the motion is toughness times depth, at any speed.
        #[test]
        fn force_of_a_drawn_blade_is_toughness_times_depth(
            depth in 2e-3..12e-3f64, angle in 0.0..std::f64::consts::TAU, speed in 0.01..0.1f64,
        ) {
            let direction = Vec3::new(angle.cos(), angle.sin(), 0.0);
            let tick = drawn(depth, direction * speed);
            let expected = direction * (-TOUGHNESS_J_M2 * depth);
            let off = (tick.wrench.force - expected).norm() / expected.norm();
            prop_assert!(off < 0.02, "{} {expected}", tick.wrench.force);
            prop_assert_eq!(tick.proxy_offset, Vec3::zeros());
        }
    }

    /// A cutting blade above y, in cells.
    fn blade(y: f64) -> ToolAt {
        ToolAt {
            participant: ParticipantId(1),
            description: ToolDescription::scalpel(6e-3, 0.02),
            position: Vec3::new(6.1, y, 4.2) * CELL_M,
            orientation: UnitQuaternion::identity(),
            buttons: 1,
            strength: 1.0,
            returns: false,
            predicted: None,
        }
    }

    #[test]
    fn blade_that_follows_its_wound_feels_nothing() {
        let mut tissue = Tissue::new(tissue());
        let pressed_n = |tissue: &Tissue| {
            let (mut force, mut model) = (CuttingForce::default(), ContactModel::FREE);
            for y in [5.0, 5.2] {
                model = ContactModel::FREE;
                force.add_to(&mut model, tissue, &blade(y));
            }
            model.touches[0].pressed_n
        };
        assert!((pressed_n(&tissue) - TOUGHNESS_J_M2 * 1.8 * CELL_M).abs() < 0.02);
        let stroke = CutStroke {
            points: (-1..12).filter_map(|y| blade(y.into()).edge()).collect(),
            width_m: 0.5e-3,
        };
        tissue.cut(&stroke).unwrap();
        assert_eq!(pressed_n(&tissue), 0.0);
    }

    /// While a hand brakes, its predicted tip moves backwards.
    #[test]
    fn braking_blade_keeps_its_direction() {
        let mut tissue = Tissue::new(tissue());
        let stroke = CutStroke {
            points: (-1..7).filter_map(|y| blade(y.into()).edge()).collect(),
            width_m: 0.5e-3,
        };
        tissue.cut(&stroke).unwrap();
        let mut force = CuttingForce::default();
        let mut newtons = |measured: f64, predicted: f64| {
            let mut tool = blade(measured);
            tool.predicted = Some(blade(predicted).solved_pose());
            let mut model = ContactModel::FREE;
            force.add_to(&mut model, &tissue, &tool);
            model.touches[0].pressed_n
        };
        newtons(5.6, 5.8);
        let moving = newtons(5.8, 6.2);
        let braking = newtons(5.9, 6.0);
        let stopped = newtons(5.9, 5.9);
        assert!(moving > 0.5, "{moving} N");
        assert!(
            (braking - moving).abs() < 0.02 && (stopped - moving).abs() < 0.02,
            "{braking} {stopped} N"
        );
    }

    #[test]
    fn hands_that_share_a_replica_follow_their_own_blades() {
        let mut tissue = Tissue::new(tissue());
        let blade = |hand: u16, y: f64, buttons: u8| ToolAt {
            participant: ParticipantId(hand),
            buttons,
            ..blade(y)
        };
        let stroke = CutStroke {
            points: (-1..12)
                .filter_map(|y| blade(1, y.into(), 1).edge())
                .collect(),
            width_m: 0.5e-3,
        };
        tissue.cut(&stroke).unwrap();
        let (mut force, mut model) = (CuttingForce::default(), ContactModel::FREE);
        for y in [5.0, 5.2] {
            model = ContactModel::FREE;
            force.add_to(&mut model, &tissue, &blade(1, y, 1));
            for others in [blade(2, 3.0, 1), blade(3, 4.0, 0)] {
                let mut theirs = ContactModel::FREE;
                force.add_to(&mut theirs, &tissue, &others);
            }
        }
        assert_eq!(model.touches[0].pressed_n, 0.0);
    }

    #[test]
    fn resting_blade_and_blade_along_its_edge_feel_nothing() {
        assert!(drawn(8e-3, Vec3::zeros()).wrench.force.norm() < 1e-9);
        assert!(drawn(8e-3, Vec3::z() * 0.01).wrench.force.norm() < 1e-9);
    }
}

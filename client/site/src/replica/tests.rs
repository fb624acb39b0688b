use std::sync::Arc;

use nalgebra::UnitQuaternion;
use palpate_protocol::operation::{BladePoint, CutStroke, Operation, OperationKind};
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_protocol::{ClientTime, OperationId, ParticipantId, ServerTime};
use palpate_tissue::{Budget, Model, Vec3, cut};

use super::*;
use crate::test_support::soft_block;
use crate::tools::tissue_stroke;

const CELL: f64 = 4e-3;

fn tissue() -> Arc<Model> {
    soft_block([10, 10, 6])
}

fn tool(who: u16, x: f64, depth: f64) -> ToolAt {
    ToolAt {
        participant: ParticipantId(who),
        description: ToolDescription::probe(6e-3),
        position: Vec3::new(x, 5.0 * CELL, 6.0 * CELL + 6e-3 - depth),
        orientation: UnitQuaternion::identity(),
        buttons: 0,
        strength: 1.0,
        returns: false,
        predicted: None,
    }
}

fn thorough() -> Budget<'static> {
    Budget::new(200, 1e-5)
}

fn seen(replica: &mut Replica) -> &mut View {
    replica.view_mut().expect("not detached")
}

fn at(k: i64) -> ServerTime {
    ServerTime::from_micros(k * 4000)
}

fn operation(replica: &mut Replica) -> Operation {
    let point = |i: usize| BladePoint {
        tip_m: [i as f64 * CELL, 5.2 * CELL, 3.5 * CELL],
        axis: [0.0, 0.0, 1.0],
        depth_m: 4.0 * CELL,
    };
    let stroke = CutStroke {
        began: ServerTime::ZERO,
        joins: false,
        points: (2..9).map(point).collect(),
        width_m: 0.5e-3,
    };
    let mut server = Topology::clone(replica.topology());
    cut(&mut server, &tissue_stroke(ParticipantId(1), &stroke).path).unwrap();
    Operation {
        id: OperationId(0),
        at: ServerTime::ZERO,
        author: ParticipantId(1),
        topology_version_before: 0,
        topology_version_after: 1,
        hash_after: palpate_protocol::TopologyHash(server.hash().0),
        kind: OperationKind::Cut(stroke),
    }
}

#[test]
fn pressing_gives_outward_force_and_usable_model() {
    let mut replica = Replica::new(tissue(), true);
    let now = ClientTime::from_micros(5);
    let own = tool(1, 5.0 * CELL, 3e-3);
    let model = replica.haptic_step(now, Some(&own), &[], thorough());
    assert!(model.is_usable() && model.in_contact());
    assert!(
        model.force().z > 0.01 && model.touches[0].normal.z > 0.9,
        "{model:?}"
    );
    assert!((model.x0 - own.position).norm() < 1e-9);
    assert_eq!(model.solved_at, now);
    let deeper = tool(1, 5.0 * CELL, 4e-3);
    let more = replica.haptic_step(now, Some(&deeper), &[], thorough());
    assert!(more.force().z > model.force().z);
    let away = tool(1, 5.0 * CELL, -10e-3);
    assert!(
        !replica
            .haptic_step(now, Some(&away), &[], thorough())
            .in_contact()
    );
}

#[test]
fn cutting_blade_presses_nothing() {
    let mut replica = Replica::new(tissue(), true);
    let mut own = tool(1, 5.0 * CELL, 3e-3);
    own.description = ToolDescription::scalpel(6e-3, 0.02);
    let pressed = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
    own.buttons = 1;
    let cuts = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
    assert!(pressed.force().norm() > 0.01 && cuts.force().norm() == 0.0);
}

#[test]
fn nearby_tool_changes_the_force() {
    let mut replica = Replica::new(tissue(), true);
    let own = tool(1, 4.0 * CELL, 3e-3);
    let alone = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
    let other = tool(2, 7.5 * CELL, 5e-3);
    let both = replica.haptic_step(ClientTime::ZERO, Some(&own), &[other], thorough());
    assert!((alone.force() - both.force()).norm() > 1e-3 * alone.force().norm());
}

#[test]
fn replicas_with_equal_inputs_have_equal_shapes() {
    let run = |with_hand: bool| {
        let mut replica = Replica::new(tissue(), with_hand);
        for k in 0..30 {
            let tools = [
                tool(1, (3.0 + 0.02 * k as f64) * CELL, 1e-4 * k as f64),
                tool(2, 7.0 * CELL, 2e-3),
            ];
            if with_hand {
                replica.haptic_step(
                    ClientTime::ZERO,
                    Some(&tools[0]),
                    &tools,
                    Budget::new(3, 1e-2),
                );
            }
            seen(&mut replica).step(at(k), &tools, Budget::new(4, 1e-3));
        }
        seen(&mut replica).shape().hash()
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn cut_gives_equal_hashes_on_all_replicas() {
    let mut a = Replica::new(tissue(), true);
    let mut b = Replica::new(tissue(), false);
    let tools = [tool(1, 5.0 * CELL, 3e-3)];
    seen(&mut a).step(at(0), &tools, thorough());
    let operation = operation(&mut a);
    a.apply(&operation).unwrap();
    b.apply(&operation).unwrap();
    assert_eq!(a.topology().hash(), b.topology().hash());
    assert_eq!(a.topology().version(), 1);
    seen(&mut a).step(at(1), &tools, thorough());
    assert_eq!(
        seen(&mut a).shape().displacement.len(),
        a.topology().node_count()
    );
    seen(&mut b).step(at(1), &tools, thorough());
    let worst = (0..a.topology().node_count())
        .map(|n| {
            (seen(&mut a).shape().displacement[n] - seen(&mut b).shape().displacement[n]).norm()
        })
        .fold(0.0, f64::max);
    assert!(worst < 0.1e-3, "{worst}");
}

#[test]
fn replayed_log_gives_the_replica_of_applied_operations() {
    let mut applied = Replica::new(tissue(), true);
    let cut = operation(&mut applied);
    let undo = Operation {
        id: OperationId(1),
        topology_version_before: 1,
        topology_version_after: 2,
        hash_after: palpate_protocol::TopologyHash(applied.topology().hash().0),
        kind: OperationKind::Undone,
        ..cut.clone()
    };
    let redo = Operation {
        id: OperationId(2),
        topology_version_before: 2,
        topology_version_after: 3,
        kind: OperationKind::Redone,
        ..cut.clone()
    };
    let mut replayed = Replica::new(tissue(), true);
    for operation in [cut, undo, redo] {
        applied.apply(&operation).unwrap();
        replayed.replay(&operation).unwrap();
        assert_eq!(applied.topology().hash(), replayed.topology().hash());
    }
    replayed.end_replay();
    let own = tool(1, 5.0 * CELL, 3e-3);
    let [a, b] = [applied, replayed].map(|mut replica| {
        let force = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
        assert_eq!(seen(&mut replica).topology().version(), 3);
        force.force()
    });
    assert!(
        a.norm() > 0.01 && (a - b).norm() < 1e-3 * a.norm(),
        "{a} {b}"
    );
}

#[test]
fn different_hash_is_reported_with_the_operation() {
    let mut replica = Replica::new(tissue(), true);
    let good = operation(&mut replica);
    let bad = Operation {
        hash_after: palpate_protocol::TopologyHash(1),
        ..good.clone()
    };
    let error = replica.apply(&bad).err().expect("another result");
    assert!(error.to_string().contains("operation 0"), "{error}");
    // The replica is unchanged.
    replica.apply(&good).unwrap();
    assert!(matches!(
        replica.apply(&good),
        Err(ReplicaError::Version { .. })
    ));
}

#[test]
fn cut_fails_when_worker_has_stopped() {
    let mut replica = Replica::new(tissue(), false);
    let cut = operation(&mut replica);
    let view = replica.detach_view();
    assert!(view.is_some() && replica.prefetch().is_none());
    assert!(matches!(
        replica.apply(&cut).err(),
        Some(ReplicaError::Ended { .. })
    ));
    assert_eq!(replica.topology().version(), 0);
}

#[test]
fn contact_model_reports_whether_its_blade_cuts() {
    let mut replica = Replica::new(tissue(), true);
    let probe = tool(1, 5.0 * CELL, 3e-3);
    let blade = ToolAt {
        description: ToolDescription {
            kind: ToolKind::Scalpel,
            length_m: 0.01,
            ..probe.description
        },
        ..probe
    };
    let cutting = ToolAt {
        buttons: 1,
        ..blade
    };
    let mut model_of = |own| replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
    for (own, cuts) in [(probe, None), (blade, Some(false))] {
        let model = model_of(own);
        assert_eq!(
            (model.was_cutting, model.in_contact()),
            (cuts, true),
            "{model:?}"
        );
    }
    assert_eq!(model_of(cutting).was_cutting, Some(true));
}

#[test]
fn energy_of_other_hands_is_tracked() {
    // A tool against 400 N/m along z: 10 mm in and out, in steps of 1 mm.
    let reaction = |depth: f64| Reaction {
        tool: 7,
        force: Vec3::new(0.0, 0.0, 400.0 * depth),
        stiffness: nalgebra::Matrix3::zeros(),
        normal: Vec3::z(),
        contacts: 1,
        friction_static: 0.0,
        friction_dynamic: 0.0,
        force_error: 0.0,
        at: Vec3::new(0.0, 0.0, -depth),
        lag_m: 0.0,
        torque: Vec3::zeros(),
        turn: UnitQuaternion::identity(),
        contact_patches: Vec::new(),
        shaft: None,
        is_inserted: false,
    };
    let mut others = ExternalWork::default();
    for mm in 0..=10 {
        others.note([reaction(1e-3 * f64::from(mm))].iter());
    }
    let stored = 0.5 * 400.0 * 1e-4;
    assert!(
        (others.work_j - stored).abs() < 1e-12,
        "{} J",
        others.work_j
    );
    for mm in (0..10).rev() {
        others.note([reaction(1e-3 * f64::from(mm))].iter());
    }
    assert!(others.work_j.abs() < 1e-12, "{} J", others.work_j);
    // A tool without contact in between has done no work.
    others.note([].iter());
    others.note([reaction(0.01)].iter());
    assert!(others.work_j.abs() < 1e-12);
}

#[test]
fn tilted_plate_and_open_jaws_give_several_contacts_and_torque() {
    let turn = UnitQuaternion::from_axis_angle(&Vec3::y_axis(), 0.1);
    let plate = ToolDescription {
        kind: ToolKind::Plate,
        length_m: 0.03,
        width_m: 0.016,
        ..ToolDescription::probe(2e-3)
    };
    let jaws = ToolDescription {
        kind: ToolKind::Grasper,
        ..plate
    };
    let mut models = Vec::new();
    for (description, orientation) in [(plate, turn), (jaws, UnitQuaternion::identity())] {
        let mut replica = Replica::new(tissue(), true);
        let own = ToolAt {
            description,
            orientation,
            position: Vec3::new(5.0 * CELL, 5.0 * CELL, 6.0 * CELL + 1e-3),
            ..tool(1, 0.0, 0.0)
        };
        let model = replica.haptic_step(ClientTime::ZERO, Some(&own), &[], thorough());
        assert!(model.is_usable() && model.in_contact());
        models.push(model);
    }
    let [plate, jaws] = models[..] else {
        unreachable!("two tools, two models")
    };
    assert!(plate.touching().count() >= 2);
    assert!(plate.turn0.angle_to(&turn) < 1e-9);
    // The end at +x is deeper and is pushed up: the torque is about -y.
    assert!(plate.torque().y < -1e-5, "{}", plate.torque());
    // One jaw's tip on either side of the pivot: their torques cancel.
    let sides = [1.0, -1.0].map(|s| jaws.touching().filter(|t| s * t.lever.x > 0.0).count());
    assert!(sides[0] > 0 && sides[1] > 0, "{sides:?}");
    assert!(jaws.force().z > 0.0 && jaws.torque().y.abs() < 1e-3 * jaws.force().z);
}

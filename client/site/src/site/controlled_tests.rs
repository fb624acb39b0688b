//! Effects of the instructor's controls on the own hand and the view.

use palpate_protocol::Pose;
use palpate_protocol::operation::HeldTool;
use palpate_protocol::tool::{INSERTED_BUTTON, ToolDescription};

use super::tests::{ME, OTHER, budget, ms, operation, own, site, tell};
use super::*;

fn at() -> palpate_device::Pose {
    palpate_device::Pose {
        position: nalgebra::Vector3::new(0.0121, 0.0119, 0.013),
        ..palpate_device::Pose::default()
    }
}

fn is_felt(site: &mut Site, t: i64) -> bool {
    let model = site.haptic_step(ms(t), at(), 0, budget()).unwrap();
    assert_eq!(model.is_absent, site.is_muted() || site.is_frozen());
    model.in_contact()
}

fn notices(site: &mut Site) -> String {
    let all: Vec<String> = std::iter::from_fn(|| site.poll_notice()).collect();
    all.join("; ")
}

fn apply(site: &mut Site, id: u64, t: i64, kind: OperationKind) {
    tell(site, operation(id, 5000 + t, kind), t);
    site.advance(ms(t)).unwrap();
}

#[test]
fn muted_hand_has_no_force_until_it_is_active_again() {
    let mut site = site(0);
    assert!(is_felt(&mut site, 10));
    let mute = |is_muted| OperationKind::Muted {
        participant: ME,
        is_muted,
    };
    apply(&mut site, 0, 20, mute(true));
    assert!(site.is_muted() && !is_felt(&mut site, 30));
    assert!(notices(&mut site).contains("muted your tool"));
    apply(&mut site, 1, 40, mute(false));
    assert!(!site.is_muted() && is_felt(&mut site, 50));
}

#[test]
fn frozen_session_shows_the_held_poses_and_no_force() {
    let mut site = site(0);
    assert!(is_felt(&mut site, 10));
    let held = HeldTool {
        participant: OTHER,
        pose: Pose {
            position_m: [0.01, 0.01, 0.017],
            ..Pose::IDENTITY
        },
        buttons: 0,
    };
    let frozen = OperationKind::Frozen {
        is_frozen: true,
        held: vec![held],
    };
    apply(&mut site, 0, 20, frozen);
    for t in [20, 500, 3000] {
        site.handle_own(&own(t, 0.02, false));
        assert!(site.is_frozen() && !is_felt(&mut site, t));
        let frame = site.next_view(ms(t + 4)).unwrap();
        let [tool] = frame.tools[..] else {
            panic!("{:?}", frame.tools)
        };
        assert_eq!(tool.participant, OTHER);
        assert_eq!(
            tool.position,
            palpate_tissue::Vec3::from(held.pose.position_m)
        );
        assert!(tool.strength > 0.0);
    }
    let goes_on = OperationKind::Frozen {
        is_frozen: false,
        held: Vec::new(),
    };
    apply(&mut site, 1, 3010, goes_on);
    assert!(is_felt(&mut site, 3020));
    let said = notices(&mut site);
    assert!(
        said.contains("frozen") && said.contains("continues"),
        "{said}"
    );
}

#[test]
fn frozen_or_muted_needle_stays_inserted() {
    let frozen = OperationKind::Frozen {
        is_frozen: true,
        held: Vec::new(),
    };
    let muted = OperationKind::Muted {
        participant: ME,
        is_muted: true,
    };
    for kind in [frozen, muted] {
        let mut site = site(0);
        apply(&mut site, 0, 20, kind);
        for (t, buttons) in [(30, INSERTED_BUTTON), (40, INSERTED_BUTTON), (50, 0)] {
            let model = site.haptic_step(ms(t), at(), buttons, budget()).unwrap();
            assert_eq!(model.is_inserted, buttons == INSERTED_BUTTON);
        }
    }
}

#[test]
fn force_limit_and_session_state_follow_the_log() {
    let mut site = site(0);
    let limit = |newtons| OperationKind::ForceLimit {
        participant: ME,
        newtons,
    };
    let model = |site: &mut Site, t| site.haptic_step(ms(t), at(), 0, budget()).unwrap();
    assert_eq!(model(&mut site, 10).force_limit_n, f64::INFINITY);
    apply(&mut site, 0, 20, limit(Some(1.5)));
    assert_eq!(model(&mut site, 22).force_limit_n, 1.5);
    assert_eq!(model(&mut site, 60).force_limit_n, 1.5);
    apply(&mut site, 1, 70, limit(None));
    assert_eq!(model(&mut site, 72).force_limit_n, f64::INFINITY);
    let annotation = palpate_protocol::examples::annotation();
    apply(
        &mut site,
        2,
        80,
        OperationKind::Annotated(annotation.clone()),
    );
    assert_eq!(site.session_state().annotations.get(&5), Some(&annotation));
    apply(&mut site, 3, 90, OperationKind::AnnotationRemoved { id: 5 });
    assert!(site.session_state().annotations.is_empty());
}

#[test]
fn changed_own_tool_decides_about_strokes() {
    let mut site = site(0);
    let stroke = |site: &mut Site, from: i64| {
        for (i, x) in [0.004, 0.010, 0.016].into_iter().enumerate() {
            site.handle_own(&own(from + 10 * i as i64, x, true));
        }
        site.handle_own(&own(from + 40, 0.016, false));
        let mut requests = std::iter::from_fn(|| site.poll_request());
        requests.any(|r| matches!(r, RequestKind::Cut(_)))
    };
    assert!(stroke(&mut site, 10));
    let change = |tool| OperationKind::ToolChanged {
        participant: ME,
        tool,
    };
    apply(&mut site, 0, 60, change(ToolDescription::probe(4e-3)));
    assert!(!stroke(&mut site, 70));
    apply(
        &mut site,
        1,
        120,
        change(ToolDescription::scalpel(5e-4, 0.02)),
    );
    assert!(stroke(&mut site, 130));
}

#[test]
fn own_held_tool_is_released_when_the_connection_was_lost() {
    let mut site = site(0);
    let held = HeldTool {
        participant: ME,
        pose: Pose {
            position_m: [0.01, 0.01, 0.017],
            ..Pose::IDENTITY
        },
        buttons: 0,
    };
    let frozen = OperationKind::Frozen {
        is_frozen: true,
        held: vec![held],
    };
    apply(&mut site, 0, 20, frozen);
    assert_eq!(site.next_view(ms(200)).unwrap().tools.len(), 1);
    apply(
        &mut site,
        1,
        210,
        OperationKind::Disconnected { participant: ME },
    );
    assert!(site.next_view(ms(400)).unwrap().tools.is_empty());
}

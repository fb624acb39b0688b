use palpate_device::HapticDevice;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_haptics::{Chain, ChainConfig};
use palpate_protocol::operation::CompensationMode;
use palpate_site::RESYNCS_MAX;
use palpate_tissue::{Material, Topology, block};

use super::*;
use crate::criteria::INSERTION_APART_MS;
use crate::disagreement::Disagreement;
use crate::dropout::Dropouts;
use crate::force_error::{ForceError, ForcePoint, minus, norm, over_script};
use crate::insertions::Insertions;
use crate::network::{Link, Outage, Outages, Step, Steps};
use crate::reference;
use crate::scripts::{Exercise, INSERTIONS, Scripts};
use crate::tool_location::ToolLocation;

fn model() -> Arc<Model> {
    let soft = Material {
        name: "soft".into(),
        young_pa: 1e4,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "test".into(),
        ..Material::default()
    };
    Arc::new(block([18, 18, 6], 0.005, &soft, 1))
}

fn simulate(model: &Arc<Model>, scripts: &Scripts, profile: &Profile, seed: u64) -> SessionResult {
    simulate_with(model, scripts, profile, seed, 500, &[])
}

fn simulate_with(
    model: &Arc<Model>,
    scripts: &Scripts,
    profile: &Profile,
    seed: u64,
    cap_ms: u32,
    session_faults: &[SessionFault],
) -> SessionResult {
    let scripts = [&scripts.holder, &scripts.cutter];
    let session = session(model, &scripts, profile, seed, cap_ms);
    session.run_with(session_faults, |_| true).unwrap()
}

fn session<'a>(
    model: &'a Arc<Model>,
    scripts: &'a [&'a Script],
    profile: &'a Profile,
    seed: u64,
    cap_ms: u32,
) -> SimulatedSession<'a> {
    SimulatedSession {
        model,
        scripts,
        motion_only: false,
        thin_spectator_count: 1,
        profile,
        seed,
        compensation: CompensationSettings {
            mode: CompensationMode::Adaptive {
                cap_us: cap_ms * 1000,
            },
            initial_delay_us: 100_000,
        },
        tick_hz: 60,
    }
}

#[test]
fn equal_seeds_give_equal_sessions_and_topologies_agree_at_the_end() {
    let model = model();
    let place = ToolLocation::find(&Topology::new(Arc::clone(&model))).unwrap();
    let scripts = Scripts::for_location(&place, 4.0).unwrap();
    let profile = Profile::named("transatlantic").unwrap();
    let a = simulate(&model, &scripts, &profile, 5);
    assert_eq!(a.troubles, Vec::<String>::new());
    assert!(a.hashes_equal() && a.counters[0].cuts == 1);
    assert!(a.topologies[0].0 > 1, "cut in parts: {:?}", a.topologies);
    // The thin spectator matches the server's resting shape within one quantisation step and keeps its rate
    // limit.
    assert_eq!(a.topologies.len(), 4);
    let thin = a.thin_results[0];
    assert!(
        thin.rest_mm.count > 0 && thin.rest_mm.max <= 0.0501,
        "{thin:?}"
    );
    assert!(thin.bits_per_s_max <= 1.05e6, "{thin:?}");
    let views: Vec<&Recording> = a.recordings.iter().collect();
    let d = Disagreement::between(&views);
    assert!(d.nodes.p95 < 0.05, "{:?}", d.nodes);
    let r = reference::run(&model, [&scripts.holder, &scripts.cutter], &[], |_| true).unwrap();
    for (recording, course) in a.recordings.iter().zip(&r.forces) {
        let felt = over_script(&recording.haptic, recording.script_started_us.unwrap());
        // A cut may release the force up to one solve earlier or later than in the reference.
        let error = ForceError::between(&felt, course).unwrap();
        assert!(error.rms_percent < 8.0, "{error:?}");
    }
    let b = simulate(&model, &scripts, &profile, 5);
    assert_eq!(a.recordings, b.recordings);
    assert_eq!(a.thin_results, b.thin_results);
}

#[test]
fn needle_is_felt_by_its_holder_and_inserted_at_every_site() {
    let model = model();
    let scripts = Scripts::of(Exercise::Needle, &model, 8.0).unwrap();
    let profile = Profile::named("transatlantic").unwrap();
    let r = simulate(&model, &scripts, &profile, 5);
    assert_eq!(r.troubles, Vec::<String>::new());
    assert!(r.hashes_equal() && r.counters[0].cuts == 1);
    for recording in &r.recordings {
        let seen = Insertions::of(recording, &r.recordings[0]);
        assert_eq!(seen.count as u64, INSERTIONS);
        assert!(seen.apart_ms.unwrap() <= INSERTION_APART_MS, "{seen:?}");
    }
    // Every site solves the same tissue around the needle.
    let d = Disagreement::between(&r.recordings.iter().collect::<Vec<_>>());
    assert!(d.contents.p95 < 0.1, "{:?}", d.contents);
    let holder = &r.recordings[0];
    let felt = over_script(&holder.haptic, holder.script_started_us.unwrap());
    let hands = [&scripts.holder, &scripts.cutter];
    let reference = reference::run(&model, hands, &[], |_| true).unwrap();
    let error = ForceError::between(&felt, &reference.forces[0]).unwrap();
    assert!(error.rms_percent < 10.0, "{error:?}");
    let dropouts = Dropouts::between(&felt, &reference.forces[0]).unwrap();
    assert_eq!(dropouts.count, 0, "{dropouts:?}");
    // A recording has every fourth tick.
    let hand = SimHand::new(scripts.holder.clone(), ScriptStart::not_yet());
    let limit_n = 4.0 * Chain::new(ChainConfig::default(), hand.caps()).slew_step_n();
    for pair in felt.windows(2) {
        let step_n = norm(minus(pair[1].force_n, pair[0].force_n));
        assert!(step_n <= limit_n + 1e-9, "{step_n}");
    }
    // It pulls on the way out.
    let pulls = |p: &ForcePoint| p.force_n[2] < -0.1 * error.max_n.max(0.2);
    assert!(felt.iter().any(pulls));
}

fn scripts_of(model: &Arc<Model>, seconds: f64) -> Scripts {
    let place = ToolLocation::find(&Topology::new(Arc::clone(model))).unwrap();
    Scripts::for_location(&place, seconds).unwrap()
}

fn delay_ms_at(recording: &Recording, second: f64) -> f64 {
    let view = recording
        .views
        .iter()
        .find(|v| v.shown_us as f64 >= second * 1e6)
        .unwrap();
    view.delay_us as f64 * 1e-3
}

#[test]
fn trainee_with_500_ms_delay_is_demoted_then_restored() {
    let model = model();
    let scripts = scripts_of(&model, 30.0);
    let near = Profile::named("metro").unwrap();
    let steps = [(0.0, 20.0), (9.0, 500.0), (19.0, 20.0)];
    let worsens = Profile::both(
        "worsens",
        Link {
            delay_ms: 20.0,
            steps: Some(Steps {
                repeat_s: None,
                delays: steps.map(|(at_s, delay_ms)| Step { at_s, delay_ms }).into(),
            }),
            ..Link::default()
        },
    );
    let slow = SessionFault::Network {
        seat: 1,
        profile: Box::new(worsens),
    };
    let r = simulate_with(&model, &scripts, &near, 3, 400, &[slow]);
    assert_eq!(r.troubles, Vec::<String>::new());
    assert!(r.hashes_equal(), "{:?}", r.topologies);
    let words = |who: usize| -> Vec<(&str, i64)> {
        let all = r.recordings[who].operations.iter();
        let of_roles = all.filter(|o| ["demoted", "restored"].contains(&o.kind.as_str()));
        of_roles.map(|o| (o.kind.as_str(), o.at_us)).collect()
    };
    let [("demoted", lifted_us), ("restored", back_us)] = words(0)[..] else {
        panic!("{:?}", words(0));
    };
    assert_eq!(
        words(0),
        words(1),
        "both trainees log the same role changes"
    );
    assert!(
        (12.0..14.5).contains(&(lifted_us as f64 * 1e-6)),
        "{lifted_us}"
    );
    assert!((29.0..32.0).contains(&(back_us as f64 * 1e-6)), "{back_us}");
    assert_eq!(r.demotions, 1);
    assert_eq!((r.counters[0].demotions, r.counters[1].demotions), (0, 1));
    assert_eq!(
        r.counters[1].cuts_refused, 1,
        "a demoted trainee's stroke must be rejected once"
    );
    let parts = r.topologies[0].0;
    assert!(parts <= 2, "{parts} parts before the demotion");
    assert_eq!(
        r.counters[1].resyncs, 0,
        "a slow network must not cause a resync"
    );
    // A network beyond the cap does not raise the playout delay D of the others.
    let lifted_s = lifted_us as f64 * 1e-6;
    let (then, later) = (
        delay_ms_at(&r.recordings[0], lifted_s),
        delay_ms_at(&r.recordings[0], lifted_s + 5.0),
    );
    assert!(then < 60.0 && later <= then, "{then} ms, then {later}");
}

#[test]
fn diverged_cut_causes_one_resync_and_second_divergence_is_an_error() {
    let model = model();
    let scripts = scripts_of(&model, 4.0);
    let profile = Profile::named("transatlantic").unwrap();
    let elsewhere = |times| SessionFault::OtherCut {
        seat: 0,
        by_m: [0.007, 0.006, 0.0],
        times,
    };
    let r = simulate_with(&model, &scripts, &profile, 5, 500, &[elsewhere(1)]);
    assert_eq!(r.troubles, Vec::<String>::new());
    assert!(r.hashes_equal() && r.counters[0].cuts == 1);
    assert_eq!((r.counters[0].resyncs, r.counters[1].resyncs), (1, 0));
    let operations = r.recordings[0].operations.iter();
    let cuts = operations.filter(|o| o.kind == "cut").count();
    assert_eq!(cuts, r.topologies[0].0 as usize, "none is recorded twice");
    let again = simulate_with(&model, &scripts, &profile, 5, 500, &[elsewhere(2)]);
    assert!(
        again.troubles[..]
            .iter()
            .any(|t| t.contains("differs again")),
        "{:?}",
        again.troubles
    );
}

#[test]
fn diverged_shape_causes_a_limited_number_of_resyncs() {
    let model = model();
    let scripts = scripts_of(&model, 12.0);
    let profile = Profile::named("metro").unwrap();
    let spoilt = |until_s| SessionFault::OtherTools {
        seat: 1,
        by_m: [0.012, 0.0, 0.0],
        from_s: 3.0,
        until_s,
    };
    let r = simulate_with(&model, &scripts, &profile, 5, 500, &[spoilt(5.5)]);
    assert_eq!(r.troubles, Vec::<String>::new());
    assert!(r.hashes_equal(), "{:?}", r.topologies);
    assert_eq!((r.counters[0].resyncs, r.counters[1].resyncs), (0, 1));
    // The force is faded out during the resync, without steps above 0.5 N.
    let felt = &r.recordings[1].haptic;
    let steps = felt.windows(2).map(|w| {
        let step = [0, 1, 2].map(|k| w[1].force_n[k] - w[0].force_n[k]);
        step.iter().map(|f| f * f).sum::<f64>().sqrt()
    });
    assert!(steps.fold(0.0, f64::max) < 0.5);
    let for_ever = simulate_with(&model, &scripts, &profile, 5, 500, &[spoilt(1e3)]);
    assert_eq!(for_ever.troubles, Vec::<String>::new());
    let resyncs = for_ever.counters[1].resyncs as usize;
    assert!((1..=RESYNCS_MAX).contains(&resyncs), "{resyncs}");
}

#[test]
fn honest_stroke_is_cut_over_a_lossy_path_with_an_outage_during_the_stroke() {
    let model = model();
    let scripts = scripts_of(&model, 8.0);
    // The stroke lasts 1.3 s, from about 4 s on; the outages also cover shifts of the start.
    for from_s in [3.6, 4.3, 5.0] {
        let outage = Outage {
            from_s,
            to_s: from_s + 1.0,
        };
        let lossy = Profile::both(
            "lossy with an outage",
            Link {
                delay_ms: 40.0,
                loss: 0.05,
                outages: Some(Outages {
                    repeat_s: None,
                    times: vec![outage],
                }),
                ..Link::default()
            },
        );
        let r = simulate_with(&model, &scripts, &lossy, 3, 400, &[]);
        assert_eq!(r.troubles, Vec::<String>::new(), "{from_s}");
        assert_eq!(r.counters[1].cuts_refused, 0, "{from_s}");
        assert!(r.hashes_equal(), "{:?}", r.topologies);
        assert_eq!(r.counters[0].cuts, 1, "{from_s}");
    }
}

#[test]
fn no_limit_takes_effect_in_honest_sessions() {
    let model = model();
    let scripts = scripts_of(&model, 12.0);
    for name in [
        "lan",
        "metro",
        "transatlantic",
        "wifi-bursts",
        "lte",
        "lossy",
        "bursts",
        "far-steps",
    ] {
        let profile = Profile::named(name).unwrap();
        let hands = [&scripts.holder, &scripts.cutter];
        let session = SimulatedSession {
            motion_only: true,
            ..session(&model, &hands, &profile, 3, 500)
        };
        let r = session.run(|_| true).unwrap();
        assert_eq!(r.troubles, Vec::<String>::new(), "{name}");
        assert!(r.topologies[0].0 >= 1, "{name}");
        assert_eq!(r.limits, LimitCounters::default(), "{name}");
    }
}

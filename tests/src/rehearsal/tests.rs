use palpate_protocol::operation::CompensationMode;
use palpate_tissue::{Material, Topology, block};

use super::*;
use crate::disagreement::Disagreement;
use crate::force_error::{ForceError, over_script};
use crate::place::Place;
use crate::reference;
use crate::scripts::Scripts;

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

fn rehearse(model: &Arc<Model>, scripts: &Scripts, profile: &Profile, seed: u64) -> Rehearsed {
    let scripts = [&scripts.holder, &scripts.cutter];
    let rehearsal = Rehearsal {
        model,
        scripts: &scripts,
        motion_only: false,
        onlookers: 1,
        profile,
        seed,
        compensation: CompensationSettings {
            mode: CompensationMode::Adaptive { cap_us: 500_000 },
            initial_delay_us: 100_000,
        },
        tick_hz: 60,
    };
    rehearsal.run(|_| true).unwrap()
}

#[test]
fn one_seed_is_one_session_and_everybody_has_the_same_topology_in_the_end() {
    let model = model();
    let place = Place::find(&Topology::new(Arc::clone(&model))).unwrap();
    let scripts = Scripts::for_place(&place, 4.0).unwrap();
    let profile = Profile::named("transatlantic").unwrap();
    let a = rehearse(&model, &scripts, &profile, 5);
    assert_eq!(a.troubles, Vec::<String>::new());
    assert!(
        a.hashes_equal() && a.topologies[0].0 == 1,
        "{:?}",
        a.topologies
    );
    // Who computes nothing shows what the server has, within a step when all rests, and within its rate.
    assert_eq!(a.topologies.len(), 4);
    let thin = a.onlooked[0];
    assert!(
        thin.rest_mm.count > 0 && thin.rest_mm.max <= 0.0501,
        "{thin:?}"
    );
    assert!(thin.bits_per_s_max <= 1.05e6, "{thin:?}");
    let views: Vec<&Recording> = a.recordings.iter().collect();
    let d = Disagreement::between(&views);
    assert!(d.nodes.p95 < 0.05, "{:?}", d.nodes);
    let r = reference::run(&model, [&scripts.holder, &scripts.cutter], |_| true).unwrap();
    for (recording, course) in a.recordings.iter().zip(&r.courses) {
        let felt = over_script(&recording.haptic, recording.script_started_us.unwrap());
        // A blade lets go when its button is pressed, up to a solve earlier or later.
        let error = ForceError::between(&felt, course).unwrap();
        assert!(error.rms_percent < 8.0, "{error:?}");
    }
    let b = rehearse(&model, &scripts, &profile, 5);
    assert_eq!(a.recordings, b.recordings);
    assert_eq!(a.onlooked, b.onlooked);
}

use palpate_tissue::{Material, block};

use super::*;

fn load_test_of(participants: usize) -> LoadTestResult {
    let soft = Material {
        name: "soft".into(),
        young_pa: 1e4,
        density_kg_m3: 1000.0,
        source: "test".into(),
        ..Material::default()
    };
    let model = Arc::new(block([24, 24, 6], 5e-3, &soft, 1));
    let profile = Profile::named("lan").unwrap();
    let load_test = LoadTest {
        model: &model,
        participants,
        profile: &profile,
        seed: 3,
        seconds: 1.0,
        tick_hz: 60,
    };
    load_test.run(|_| ()).unwrap()
}

#[test]
fn all_participants_join_and_touching_tools_are_solved() {
    let result = load_test_of(8);
    assert!(result.troubles.is_empty(), "{:?}", result.troubles);
    assert!(result.rounds.len() > 20, "{}", result.rounds.len());
    assert!(result.rounds.iter().any(|r| r.iterations > 0));
    assert!(
        result
            .rounds
            .iter()
            .all(|r| r.decode_us >= 0 && r.tick_us > 0)
    );
}

#[test]
fn uplink_per_participant_is_independent_of_their_number() {
    let up = |n: usize| load_test_of(n).bytes[0] as f64 / n as f64;
    let (few, many) = (up(2), up(8));
    assert!(many < 1.3 * few, "{few} B, then {many} B");
}

#[test]
fn one_quarter_of_participants_touches_but_at_least_one() {
    assert_eq!([1, 2, 4, 8, 32, 64].map(touching), [1, 1, 1, 2, 8, 16]);
}

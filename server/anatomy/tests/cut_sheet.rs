//! The sheet of a cut over random strokes on the samples, and on a real thigh and torso when `PALPATE_DATA` names their
//! folder.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "../../tissue/tests/strokes/mod.rs"]
mod strokes;

mod real_models;

use std::sync::Arc;

use palpate_anatomy::sample::Sample;
use palpate_anatomy::{SceneInput, build};
use palpate_tissue::Topology;
use strokes::sheet_laws::{OPEN_M, Tally, check, check_crossings, count};

/// Least shares of the nodes inside, on interfaces and at crossings that are on the swept surface, over all models of a
/// test. Others are on interfaces that meet the blade flatly, on creases, or between walls, interfaces and the blade in one
/// cell. The shares of a single model change by up to 0.03 when its nodes move by 1e-9 m.
const SHARES: [f64; 3] = [0.985, 0.90, 0.0];
/// The same where a second stroke crosses the wound of a first.
const CROSSING_SHARES: [f64; 3] = [0.985, 0.89, 0.69];

/// Greatest root mean squares of the angle between triangles inside: whole strokes, pieces, and across a wound.
const ANGLES_DEG: [f64; 3] = [5.2, 8.8, 14.0];

/// Cuts each model with a number of random strokes: whole, in pieces, and across each other.
fn check_models(models: &[(&str, SceneInput, u64)]) {
    let mut tallies: [Tally; 3] = Default::default();
    for (name, input, strokes) in models {
        let (model, _) = build(input, &mut |_, _| ()).unwrap();
        let uncut = Topology::new(Arc::new(model));
        let found = [
            check(&uncut, count(*strokes), None, 0.0),
            check(&uncut, count(strokes.div_ceil(5)), Some(2e-3), 0.0),
            check_crossings(&uncut, count(strokes.div_ceil(4)), 0.0),
        ];
        for (tally, found) in tallies.iter_mut().zip(found) {
            println!(
                "{name}: {found:?} {:?} {}",
                found.shares(),
                found.angle_deg()
            );
            tally.add(&found);
        }
        // The laws alone.
        check(&uncut, count(strokes.div_ceil(5)), None, OPEN_M);
        check(&uncut, count(strokes.div_ceil(10)), Some(2e-3), OPEN_M);
        check_crossings(&uncut, count(strokes.div_ceil(8)), OPEN_M);
    }
    let least = [SHARES, SHARES, CROSSING_SHARES];
    for ((tally, least), greatest) in tallies.iter().zip(least).zip(ANGLES_DEG) {
        let shares = tally.shares();
        println!("{tally:?} {shares:?} {}", tally.angle_deg());
        assert!(
            shares
                .iter()
                .zip(least)
                .all(|(share, least)| *share >= least)
        );
        assert!(tally.angle_deg() <= greatest, "{}", tally.angle_deg());
    }
}

#[test]
fn random_strokes_on_the_samples_keep_the_laws() {
    let models = [
        (Sample::Thigh, 200),
        (Sample::AbdominalWall, 100),
        (Sample::Leg, 100),
        (Sample::Handle, 100),
    ];
    check_models(&models.map(|(sample, strokes)| ("sample", sample.input().unwrap(), strokes)));
}

#[test]
fn random_strokes_on_a_real_thigh_and_torso_keep_the_laws() {
    let Some(folder) = real_models::folder() else {
        return;
    };
    check_models(&[
        ("real thigh", real_models::thigh(&folder), 200),
        ("real torso", real_models::torso(&folder), 100),
    ]);
}

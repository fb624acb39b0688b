//! The sheet of a cut over random strokes on the samples, and on a real thigh when `PALPATE_DATA` names its folder.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "../../tissue/tests/strokes/mod.rs"]
mod strokes;

mod real_thigh;

use std::sync::Arc;

use palpate_anatomy::sample::Sample;
use palpate_anatomy::{SceneInput, build};
use palpate_tissue::Topology;
use strokes::sheet_laws::{check, count};

/// Least shares of the nodes inside and on interfaces that are on the swept surface. Interfaces of built models keep the
/// others: cells were built flat on them, and some interfaces meet the blade flatly.
const SHARES: [f64; 2] = [0.9, 0.5];

fn check_model(name: &str, input: &SceneInput, strokes: u64) {
    let (model, _) = build(input, &mut |_, _| ()).unwrap();
    let uncut = Topology::new(Arc::new(model));
    for (strokes, piece_m) in [(strokes, None), (strokes.div_ceil(20), Some(2e-3))] {
        let tally = check(&uncut, count(strokes), piece_m);
        println!("{name} {piece_m:?}: {tally:?} {:?}", tally.shares());
        for (share, least) in tally.shares().into_iter().zip(SHARES) {
            assert!(share > least, "{name} {piece_m:?}: {share}");
        }
    }
}

#[test]
fn random_strokes_on_the_samples_keep_the_laws() {
    for (sample, strokes) in [
        (Sample::Thigh, 200),
        (Sample::AbdominalWall, 100),
        (Sample::Leg, 100),
        (Sample::Handle, 100),
    ] {
        check_model(&format!("{sample:?}"), &sample.input().unwrap(), strokes);
    }
}

#[test]
fn random_strokes_on_a_real_thigh_keep_the_laws() {
    let Some(folder) = real_thigh::folder() else {
        return;
    };
    check_model("real thigh", &real_thigh::scene(&folder), 200);
}

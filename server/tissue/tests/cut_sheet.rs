//! The sheet of a cut over random strokes on a block: planes and curves, whole and in pieces.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod strokes;

use std::sync::Arc;

use palpate_tissue::{Material, Topology, block};
use strokes::sheet_laws::{OPEN_M, check, check_crossings, count};

fn uncut() -> Topology {
    let material = Material::default();
    Topology::new(Arc::new(block([20, 16, 12], 5e-3, &material, 0)))
}

#[test]
fn random_strokes_on_a_block_keep_the_laws_and_reach_the_swept_surface() {
    let count = count(2000);
    let tally = check(&uncut(), count, None, 0.0);
    println!("{tally:?} {:?} {}", tally.shares(), tally.angle_deg());
    assert!(tally.refused as u64 <= count / 5);
    let [inside, interface, _] = tally.shares();
    assert!(inside > 0.999, "{inside}");
    assert!(interface > 0.98, "{interface}");
    // 4.7 without spreading.
    assert!(tally.angle_deg() < 4.0, "{}", tally.angle_deg());
}

#[test]
fn strokes_that_cross_an_earlier_wound_keep_the_laws_and_reach_the_swept_surface() {
    let count = count(200);
    let tally = check_crossings(&uncut(), count, 0.0);
    println!("{tally:?} {:?} {}", tally.shares(), tally.angle_deg());
    assert!(tally.refused as u64 <= count / 3);
    let [inside, interface, crossing] = tally.shares();
    assert!(inside > 0.995, "{inside}");
    assert!(interface > 0.97, "{interface}");
    assert!(crossing > 0.9, "{crossing}");
}

#[test]
fn strokes_in_pieces_open_nearly_the_sheet_of_the_whole_stroke() {
    let count = count(100);
    let whole = check(&uncut(), count, None, 0.0);
    for length_m in [1e-3, 3e-3] {
        let tally = check(&uncut(), count, Some(length_m), 0.0);
        println!(
            "{length_m}: {tally:?} {:?} {}",
            tally.shares(),
            tally.angle_deg()
        );
        let faces = tally.faces as f64 / whole.faces as f64;
        assert!((faces - 1.0).abs() < 0.1, "{faces}");
        let [inside, interface, _] = tally.shares();
        assert!(inside > 0.98, "{inside}");
        assert!(interface > 0.94, "{interface}");
        assert!(tally.angle_deg() < 9.2, "{}", tally.angle_deg());
    }
}

#[test]
fn open_wounds_keep_the_laws() {
    for tally in [
        check(&uncut(), count(400), None, OPEN_M),
        check(&uncut(), count(100), Some(1e-3), OPEN_M),
        check_crossings(&uncut(), count(200), OPEN_M),
    ] {
        println!("{tally:?} {}", tally.angle_deg());
        assert!(tally.faces > 5000);
    }
}

//! Random strokes in sequence: none may break an invariant, and all are reproducible.

#![allow(clippy::unwrap_used)]

mod cut_laws;

use std::sync::Arc;

use cut_laws::Outline;
use palpate_tissue::snapshot::{restore, snapshot};
use palpate_tissue::{BladePoint, CutHistory, CutStroke, Model, Topology, Vec3, block, cut};
use proptest::prelude::*;

const D: f64 = 0.004;
const CELLS: [usize; 3] = [7, 6, 5];

fn model(pinned: usize) -> Arc<Model> {
    Arc::new(block(CELLS, D, &cut_laws::rubber(), pinned))
}

/// Numbers between -0.3 and 1.3: fractions of the block's sides, with a margin on each side.
fn place() -> impl Strategy<Value = Vec3> {
    (-0.3..1.3, -0.3..1.3, -0.3..1.3).prop_map(|(x, y, z): (f64, f64, f64)| {
        let [a, b, c] = CELLS.map(|n| n as f64 * D);
        Vec3::new(x * a, y * b, z * c)
    })
}

fn direction() -> impl Strategy<Value = Vec3> {
    (-1.0..1.0, -1.0..1.0, -1.0..1.0f64)
        .prop_map(|(x, y, z)| Vec3::new(x, y, z))
        .prop_filter("not too short", |v| v.norm() > 0.1)
        .prop_map(|v| v.normalize())
}

prop_compose! {
    /// A bent stroke: 2 to 5 points, the blade turning on the way.
    fn strokes()(
        start in place(),
        axis in direction(),
        bends in proptest::collection::vec((direction(), 1.0..6.0, -0.3..0.3), 1..5),
        depth in 2.0..9.0,
        wide in prop_oneof![3 => Just(0.0), 1 => 0.0..0.002],
    ) -> CutStroke {
        let first = BladePoint { tip: start, axis, depth_m: depth * D };
        let mut points = vec![first];
        for (way, length, turn) in bends {
            let last: BladePoint = points[points.len() - 1];
            let turned: Vec3 = last.axis + way.cross(&last.axis) * turn;
            points.push(BladePoint {
                tip: last.tip + way * length * D,
                axis: turned.normalize(),
                depth_m: depth * D,
            });
        }
        CutStroke { points, width_m: wide }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 120, failure_persistence: None, ..Default::default() })]

    #[test]
    fn random_strokes_keep_invariants(
        pinned in 0usize..2,
        strokes in proptest::collection::vec(strokes(), 1..7),
    ) {
        let model = model(pinned);
        let mut t = Topology::new(Arc::clone(&model));
        let before = Outline::of(&t);
        let mut wide = false;
        for s in &strokes {
            let hash = t.hash();
            let version = t.version();
            if cut(&mut t, s).is_ok() {
                prop_assert_eq!(t.version(), version + 1);
                prop_assert_ne!(t.hash(), hash);
                // Widening takes rest volume on purpose, up to its own bound.
                wide |= s.width_m > 0.0;
                cut_laws::check_within(&t, &before, if wide { 0.3 } else { 5e-3 });
            } else {
                prop_assert_eq!(t.hash(), hash);
            }
        }
        // The same strokes give the same topology, and a snapshot restores it.
        let mut again = Topology::new(Arc::clone(&model));
        for s in &strokes {
            let _ = cut(&mut again, s);
        }
        prop_assert_eq!(again.hash(), t.hash());
        prop_assert_eq!(again.boundary(), t.boundary());
        let uncut = Arc::new(Topology::new(model));
        let bytes = snapshot(&t, &CutHistory::new(Arc::clone(&uncut)));
        let (back, _) = restore(&uncut, &bytes).unwrap();
        prop_assert_eq!(back.hash(), t.hash());
        prop_assert_eq!(back.boundary(), t.boundary());
        cut_laws::check_derived(&back);
        // The restored topology can be cut in the same way.
        let mut back = Arc::unwrap_or_clone(back);
        for s in strokes.iter().rev() {
            prop_assert_eq!(cut(&mut back, s), cut(&mut t, s));
        }
        prop_assert_eq!(back.hash(), t.hash());
    }
}

/// The uncut topology, and a snapshot of it with two strokes, of which one was taken back.
fn two_strokes() -> (Arc<Topology>, Vec<u8>) {
    let uncut = Arc::new(Topology::new(model(1)));
    let mut t = Arc::clone(&uncut);
    let mut history = CutHistory::new(Arc::clone(&uncut));
    for x in [3.3, 5.2] {
        let point = |y: f64| BladePoint {
            tip: Vec3::new(x * D, y * D, 2.2 * D),
            axis: Vec3::z(),
            depth_m: 3.0 * D,
        };
        let stroke = CutStroke {
            points: vec![point(-1.0), point(7.0)],
            width_m: 0.0,
        };
        history.cut(&mut t, (&stroke).into()).unwrap();
    }
    history.undo(&mut t).unwrap();
    let bytes = snapshot(&t, &history);
    (uncut, bytes)
}

#[test]
fn damaged_snapshot_is_rejected() {
    let (uncut, good) = two_strokes();
    let (_, history) = restore(&uncut, &good).unwrap();
    assert!(history.can_undo() && history.can_redo());
    for at in 0..good.len() {
        let mut bad = good.clone();
        bad[at] ^= 0x41;
        assert!(restore(&uncut, &bad).is_err(), "byte {at}");
    }
    for at in (0..good.len()).step_by(7) {
        assert!(restore(&uncut, &good[..at]).is_err(), "length {at}");
    }
}

#[test]
fn snapshot_of_another_model_is_rejected() {
    let (uncut, bytes) = two_strokes();
    let other = block([7, 6, 6], D, &cut_laws::rubber(), 1);
    let other = Arc::new(Topology::new(Arc::new(other)));
    let error = restore(&other, &bytes).unwrap_err().to_string();
    let (taken, this) = (uncut.hash(), other.hash());
    let expected = format!("was taken of uncut topology {taken}, and this is {this}");
    assert!(error.contains(&expected), "{error}");
}

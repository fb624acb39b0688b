//! Random strokes in sequence: none may break an invariant, and all are reproducible.

#![allow(clippy::unwrap_used)]

mod cut_laws;

use std::sync::Arc;

use cut_laws::Outline;
use palpate_tissue::snapshot::{model_hash, restore, snapshot};
use palpate_tissue::{BladePoint, CutStroke, Model, Shape, Topology, Vec3, block, cut};
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
        let mut shape = Shape::rest(&t);
        for (i, u) in shape.displacement.iter_mut().enumerate() {
            *u += Vec3::new(i as f64, 1.0, -0.5) * 1e-7;
        }
        let (back, back_shape) = restore(Arc::clone(&model), &snapshot(&t, &shape)).unwrap();
        prop_assert_eq!(back.hash(), t.hash());
        prop_assert_eq!(back_shape.hash(), shape.hash());
        prop_assert_eq!(back.boundary(), t.boundary());
        cut_laws::check_derived(&back);
        // The restored topology can be cut in the same way.
        let mut back = back;
        for s in strokes.iter().rev() {
            prop_assert_eq!(cut(&mut back, s), cut(&mut t, s));
        }
        prop_assert_eq!(back.hash(), t.hash());
    }
}

fn one_cut() -> (Arc<Model>, Topology, Shape) {
    let model = model(1);
    let mut t = Topology::new(Arc::clone(&model));
    let point = |y: f64| BladePoint {
        tip: Vec3::new(3.3 * D, y * D, 2.2 * D),
        axis: Vec3::z(),
        depth_m: 3.0 * D,
    };
    let points = vec![point(-1.0), point(7.0)];
    cut(
        &mut t,
        &CutStroke {
            points,
            width_m: 0.0,
        },
    )
    .unwrap();
    let shape = Shape::rest(&t);
    (model, t, shape)
}

#[test]
fn damaged_snapshot_is_rejected() {
    let (model, t, shape) = one_cut();
    let good = snapshot(&t, &shape);
    assert!(restore(Arc::clone(&model), &good).is_ok());
    for at in 0..good.len() {
        let mut bad = good.clone();
        bad[at] ^= 0x41;
        assert!(restore(Arc::clone(&model), &bad).is_err(), "byte {at}");
    }
    for at in (0..good.len()).step_by(7) {
        assert!(
            restore(Arc::clone(&model), &good[..at]).is_err(),
            "length {at}"
        );
    }
}

#[test]
fn snapshot_of_another_model_is_rejected() {
    let (_, t, shape) = one_cut();
    let other = block([7, 6, 6], D, &cut_laws::rubber(), 1);
    let hashes = [t.model().as_ref(), &other].map(|m| format!("{:016x}", model_hash(m)));
    let error = restore(Arc::new(other), &snapshot(&t, &shape)).unwrap_err();
    let [taken, this] = &hashes;
    let expected = format!("was taken of model {taken}, and this is model {this}");
    assert!(error.to_string().contains(&expected), "{error}");
}

//! Laws of the owning type: topology, shape and solver follow every cut together.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use palpate_tissue::{BladePoint, Budget, CutStroke, Material, Tissue, Tool, Vec3, block};

const CELL: f64 = 4e-3;
const RADIUS: f64 = 8e-3;

/// A tissue after a press of quick steps, which leave deferred displacements.
fn pressed() -> Tissue {
    let model = block([32, 16, 8], CELL, &Material::default(), 1);
    let mut tissue = Tissue::new(Arc::new(model));
    (0..40).for_each(|k| press(&mut tissue, k));
    tissue
}

fn press(tissue: &mut Tissue, k: u32) {
    let depth = (0.3e-3 * f64::from(k)).min(6e-3);
    let x = 7.0 * CELL + 0.05e-3 * f64::from(k);
    let tool = Tool::ball(
        1,
        Vec3::new(x, 8.0 * CELL, 8.0 * CELL + RADIUS - depth),
        RADIUS,
    );
    let budget = Budget {
        near: true,
        ..Budget::new(2, 0.02)
    };
    tissue.step(&[tool], budget);
}

fn stroke(x: f64) -> CutStroke {
    let point = |i: u32| BladePoint {
        tip: Vec3::new(x, CELL * (4.0 + f64::from(i)), 4.1 * CELL),
        axis: Vec3::z(),
        depth_m: 0.03,
    };
    CutStroke {
        points: (0..9).map(point).collect(),
        width_m: 0.0,
    }
}

/// Hashes of topology and shape.
fn hashes(tissue: &Tissue) -> (u64, u64) {
    (tissue.topology().hash().0, tissue.shape().hash())
}

#[test]
fn own_cut_and_prepared_cut_give_equal_bits() {
    let (mut own, mut adopting) = (pressed(), pressed());
    let mut preparer = adopting.preparer();
    for (k, x) in [(40, 22.4 * CELL), (60, 12.4 * CELL)] {
        own.cut(&stroke(x)).unwrap();
        adopting.succeed(preparer.prepare(&stroke(x)).unwrap());
        assert_eq!(hashes(&own), hashes(&adopting), "before the next step");
        for k in k..k + 20 {
            press(&mut own, k);
            press(&mut adopting, k);
        }
        assert_eq!(hashes(&own), hashes(&adopting), "after further steps");
    }
}

#[test]
fn repeated_cut_suits_a_second_shape() {
    let first = pressed();
    let mut shapes = [first.another(), first.another()];
    let mut preparer = first.preparer();
    let cut = preparer.prepare(&stroke(22.4 * CELL)).unwrap();
    let cuts = [preparer.repeat(&cut), cut];
    for (shape, cut) in shapes.iter_mut().zip(cuts) {
        shape.succeed(cut);
        (0..20).for_each(|k| press(shape, k));
    }
    assert_eq!(hashes(&shapes[0]), hashes(&shapes[1]));
    assert!(Arc::ptr_eq(shapes[0].topology(), shapes[1].topology()));
    // The tissue that did not adopt the cut is unchanged.
    assert_eq!(first.topology().version(), 0);
}

#[test]
fn rejected_cut_changes_nothing() {
    let mut tissue = pressed();
    let before = hashes(&tissue);
    let miss = stroke(2.0);
    assert!(tissue.cut(&miss).is_err());
    let mut preparer = tissue.preparer();
    assert!(preparer.prepare(&miss).is_err());
    assert_eq!(preparer.topology().version(), 0);
    assert_eq!(hashes(&tissue), before);
}

//! Laws of a cut, on blocks: closed surface, mass, volume, valid cells, reproducible history.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod cut_laws;

use std::sync::Arc;

use cut_laws::{Outline, check_all, stroke, topology};
use palpate_tissue::{
    BladePoint, CutError, CutStroke, Shape, Tissue, Topology, Vec3, block, cut, to_rest,
};

const D: f64 = 0.005;

/// A blade that stands along z and moves from one x, y to another, `depth` deep from the top of a
/// block `height` high.
fn upright(from: [f64; 2], to: [f64; 2], height: f64, depth: f64) -> CutStroke {
    let at = |p: [f64; 2]| Vec3::new(p[0], p[1], height - depth);
    stroke(&[at(from), at(to)], Vec3::z(), depth)
}

#[test]
fn cut_between_cells_moves_no_node_and_keeps_the_surface_closed() {
    let mut t = topology([8, 8, 8], D);
    let before = Outline::of(&t);
    let s = upright([4.0 * D, -D], [4.0 * D, 9.0 * D], 8.0 * D, 4.0 * D);
    let outcome = cut(&mut t, &s).unwrap();
    assert_eq!(outcome.faces_opened, 32);
    assert_eq!(outcome.doubled.len(), 9 * 4);
    assert_eq!(outcome.nodes_short, 0);
    assert!(
        outcome
            .moved
            .iter()
            .all(|m| (t.rest(m.node).x / D).fract().abs() < 1e-9)
    );
    check_all(&t, &before);
    assert_eq!(t.components(), 1);
    assert_eq!(outcome.components_near, 1);
}

#[test]
fn through_cut_gives_exact_halves_at_any_tilt() {
    for degrees in [0.0f64, 7.0, 30.0, 45.0, 60.0] {
        let n = 12;
        let mut t = topology([n, n, n], D);
        let before = Outline::of(&t);
        let side = n as f64 * D;
        let middle = Vec3::repeat(side / 2.0);
        let (sin, cos) = degrees.to_radians().sin_cos();
        let axis = Vec3::new(sin, 0.0, cos);
        let far = Vec3::new(0.0, side, 0.0);
        let tip = middle - axis * side;
        let s = stroke(&[tip - far, tip + far], axis, 2.0 * side);
        let outcome = cut(&mut t, &s).unwrap();
        check_all(&t, &before);
        let volumes = t.component_volumes();
        assert_eq!(volumes.len(), 2, "at {degrees} degrees");
        assert_eq!(outcome.components_near, 2);
        let half = side.powi(3) / 2.0;
        for v in volumes {
            assert!(
                (v / half - 1.0).abs() < 0.02,
                "{degrees} degrees: {v} of {half}"
            );
        }
        // Nodes short of the plane are short by less than half a spacing; all others are on it.
        let normal = Vec3::new(cos, 0.0, -sin);
        let mut on = 0;
        for &(new, old) in &outcome.doubled {
            assert_eq!(t.rest(new), t.rest(old));
            let off = (t.rest(new) - middle).dot(&normal).abs() / D;
            assert!(off < 0.5, "{degrees} degrees: {off}");
            on += usize::from(off < 1e-6);
        }
        println!(
            "{degrees} degrees: {} snapped, {} short, {on} of {} doubled on the plane",
            outcome.nodes_snapped,
            outcome.nodes_short,
            outcome.doubled.len()
        );
        assert!(outcome.doubled.len() - on <= outcome.nodes_short);
    }
}

#[test]
fn oblique_cut_is_snapped_onto_the_blade() {
    for off in [0.1, 0.3, 0.49, 0.51, 0.8] {
        let mut t = topology([8, 8, 8], D);
        let before = Outline::of(&t);
        let x = (4.0 + off) * D;
        let outcome = cut(&mut t, &upright([x, -D], [x, 9.0 * D], 8.0 * D, 4.0 * D)).unwrap();
        assert_eq!(outcome.nodes_short, 0, "at {off}");
        assert!(
            outcome
                .doubled
                .iter()
                .all(|d| (t.rest(d.0).x - x).abs() < 1e-6 * D)
        );
        check_all(&t, &before);
    }
}

#[test]
fn curved_cut_keeps_the_laws_and_the_curve() {
    let mut t = topology([16, 16, 8], D);
    let before = Outline::of(&t);
    let radius = 10.0 * D;
    let points: Vec<Vec3> = (0..=40)
        .map(|i| {
            let a = f64::from(i) / 40.0 * 1.4;
            Vec3::new(radius * a.cos(), radius * a.sin(), 3.0 * D) + Vec3::new(2.0, 2.0, 0.0) * D
        })
        .collect();
    let outcome = cut(&mut t, &stroke(&points, Vec3::z(), 6.0 * D)).unwrap();
    check_all(&t, &before);
    let mut offs = Vec::new();
    for &(node, _) in &outcome.doubled {
        let p = t.rest(node) - Vec3::new(2.0, 2.0, 0.0) * D;
        let off = (p.xy().norm() - radius).abs();
        offs.push(off / D);
    }
    offs.sort_by(f64::total_cmp);
    let at = |share: f64| offs[((offs.len() - 1) as f64 * share) as usize];
    println!(
        "{} snapped, {} short; off by p50 {:.4} p90 {:.4} max {:.4} spacings",
        outcome.nodes_snapped,
        outcome.nodes_short,
        at(0.5),
        at(0.9),
        at(1.0)
    );
    assert!(at(1.0) < 0.3 && at(0.9) < 0.1);
}

#[test]
fn crossing_continued_deepened_and_repeated_cuts_keep_invariants() {
    let mut t = topology([12, 12, 8], D);
    let before = Outline::of(&t);
    let h = 8.0 * D;
    let along = |y: f64, from: f64, to: f64, depth: f64| {
        upright([from * D, y * D], [to * D, y * D], h, depth * D)
    };
    cut(&mut t, &along(6.2, -1.0, 7.0, 3.0)).unwrap();
    check_all(&t, &before);
    // Continued, then deepened.
    cut(&mut t, &along(6.2, 6.5, 11.0, 3.0)).unwrap();
    check_all(&t, &before);
    cut(&mut t, &along(6.2, 2.0, 9.0, 6.0)).unwrap();
    check_all(&t, &before);
    // A repeated stroke separates nothing.
    let hash = t.hash();
    let again = cut(&mut t, &along(6.2, 2.0, 9.0, 6.0));
    assert_eq!(again, Err(CutError::NothingNew));
    assert_eq!(t.hash(), hash);
    let outline = before;
    let check_all = |t: &Topology| cut_laws::check_within(t, &outline, 1e-4);
    // Crossing at a right angle and obliquely.
    cut(
        &mut t,
        &upright([5.4 * D, -D], [5.4 * D, 13.0 * D], h, 5.0 * D),
    )
    .unwrap();
    check_all(&t);
    cut(
        &mut t,
        &upright([0.0, 1.3 * D], [12.0 * D, 11.1 * D], h, 4.0 * D),
    )
    .unwrap();
    check_all(&t);
    // A horizontal cut under all of them frees pieces.
    let plane: Vec<Vec3> = [-D, 13.0 * D]
        .iter()
        .map(|&y| Vec3::new(-D, y, 5.1 * D))
        .collect();
    cut(&mut t, &stroke(&plane, Vec3::x(), 14.0 * D)).unwrap();
    check_all(&t);
    assert!(t.components() > 3, "{} components", t.components());
}

#[test]
fn short_inner_cut_keeps_one_piece() {
    let mut t = topology([10, 10, 6], D);
    let before = Outline::of(&t);
    let s = upright([3.0 * D, 5.0 * D], [7.0 * D, 5.0 * D], 6.0 * D, 3.0 * D);
    let outcome = cut(&mut t, &s).unwrap();
    assert_eq!(outcome.faces_opened, 12);
    // Only the part between the ends opens: three columns, three rows.
    assert_eq!(outcome.doubled.len(), 9);
    assert_eq!(t.components(), 1);
    check_all(&t, &before);
}

#[test]
fn rejected_stroke_returns_the_reason_and_changes_nothing() {
    let mut t = Topology::new(Arc::new(block([6, 6, 6], D, &cut_laws::rubber(), 2)));
    let hash = t.hash();
    let good = upright([3.0 * D, 0.0], [3.0 * D, 6.0 * D], 6.0 * D, 3.0 * D);
    let with = |change: fn(&mut CutStroke)| {
        let mut s = good.clone();
        change(&mut s);
        s
    };
    let low = Vec3::new(0.0, 0.0, -3.5 * D);
    let mut bone = good.clone();
    bone.points.iter_mut().for_each(|p| p.tip += low);
    bone.points.iter_mut().for_each(|p| p.depth_m = 2.5 * D);
    for (s, word) in [
        (with(|s| s.points.truncate(1)), "blade points"),
        (with(|s| s.points[1].tip.x = f64::NAN), "not finite"),
        (with(|s| s.points[1].axis *= 2.0), "unit vector"),
        (with(|s| s.points[0].depth_m = 0.0), "deep"),
        (with(|s| s.points[0].depth_m = 3.0), "deep"),
        (with(|s| s.width_m = -1.0), "wide"),
        (with(|s| s.points[1] = s.points[0]), "does not move"),
        (with(|s| s.points[1].tip.y = 9.0), "long"),
        (
            with(|s| s.points[1].tip = s.points[0].tip + Vec3::z() * 0.01),
            "sideways",
        ),
        (
            with(|s| s.points.iter_mut().for_each(|p| p.tip.x += 1.0)),
            "no tissue",
        ),
        (bone, "`base`"),
    ] {
        let error = match cut(&mut t, &s) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("the stroke cut instead of the error: {word}"),
        };
        assert!(error.contains(word), "{word}: {error}");
        assert_eq!(t.hash(), hash);
    }
}

#[test]
fn pinned_bone_stops_the_blade() {
    let mut t = Topology::new(Arc::new(block([8, 8, 8], D, &cut_laws::rubber(), 3)));
    let before = Outline::of(&t);
    let s = upright([4.2 * D, -D], [4.2 * D, 9.0 * D], 8.0 * D, 8.5 * D);
    let outcome = cut(&mut t, &s).unwrap();
    assert_eq!(outcome.faces_opened, 8 * 5);
    assert_eq!(t.components(), 1);
    for node in 0..t.node_count() as u32 {
        if t.is_pinned(node) {
            let x = t.rest(node).x / D;
            assert!((x - x.round()).abs() < 1e-9);
        }
    }
    check_all(&t, &before);
}

/// A blade along x at a height, moved along y over a part of the block.
fn level(height: f64, to: f64) -> CutStroke {
    let at = |y: f64| Vec3::new(-D, y, height);
    stroke(&[at(-D), at(to)], Vec3::x(), 10.0 * D)
}

#[test]
fn blade_along_bone_parts_tissue_from_it() {
    let bone = 3.0 * D;
    for height in [bone + 0.2 * D, bone - 0.3 * D] {
        let mut t = Topology::new(Arc::new(block([8, 8, 8], D, &cut_laws::rubber(), 3)));
        let before = Outline::of(&t);
        let outcome = cut(&mut t, &level(height, 9.0 * D)).unwrap();
        assert_eq!(outcome.faces_opened, 64);
        assert_eq!(outcome.doubled.len(), 81);
        assert!(outcome.moved.is_empty());
        assert_eq!(t.components(), 2);
        for &(tissue, bone) in &outcome.doubled {
            assert!(t.is_pinned(bone) && !t.is_pinned(tissue));
        }
        check_all(&t, &before);
    }
}

#[test]
fn wide_wound_opens_at_the_top_and_closes_at_the_front() {
    let mut t = topology([8, 8, 8], D);
    let before = Outline::of(&t);
    let mut s = upright([4.2 * D, -D], [4.2 * D, 9.0 * D], 8.0 * D, 4.0 * D);
    s.width_m = 0.08 * D;
    let outcome = cut(&mut t, &s).unwrap();
    let gap = |z: f64| {
        let at = |d: &&(u32, u32)| (t.rest(d.0).z - z).abs() < 0.1 * D;
        let pair = outcome.doubled.iter().find(at).unwrap();
        (t.rest(pair.0) - t.rest(pair.1)).norm()
    };
    assert!((gap(8.0 * D) / (0.08 * D) - 1.0).abs() < 1e-6);
    assert!((gap(6.0 * D) / (0.04 * D) - 1.0).abs() < 1e-6);
    cut_laws::check_surface(&t);
    cut_laws::check_cells(&t);
    cut_laws::check_derived(&t);
    let lost = 1.0 - cut_laws::volume(&t) / before.volume;
    assert!((0.0..0.005).contains(&lost), "{lost}");
}

#[test]
fn wide_wound_across_the_lattice_follows_the_width_law() {
    let mut t = topology([16, 16, 8], D);
    let before = Outline::of(&t);
    let middle = Vec3::new(8.0, 8.0, 0.0) * D;
    let along = Vec3::new(0.9, 0.43, 0.0).normalize();
    let [from, to] = [-5.0, 5.0].map(|s| middle + along * (s * D));
    let (height, depth, width) = (8.0 * D, 5.0 * D, 0.08 * D);
    let mut s = upright([from.x, from.y], [to.x, to.y], height, depth);
    s.width_m = width;
    let outcome = cut(&mut t, &s).unwrap();
    let normal = along.cross(&Vec3::z());
    let is_on_law = |d: &&(u32, u32)| {
        let [a, b] = [t.rest(d.0), t.rest(d.1)];
        let law = width * (1.0 - (height - a.z) / depth);
        ((a - b).dot(&normal).abs() - law).abs() < 0.01 * width
    };
    let on = outcome.doubled.iter().filter(is_on_law).count();
    println!("{on} of {} pairs on the law", outcome.doubled.len());
    // Cells at steps of the lattice are thin; most of their nodes still reach their place.
    assert!(on * 10 >= outcome.doubled.len() * 9, "{on}");
    cut_laws::check_surface(&t);
    cut_laws::check_cells(&t);
    cut_laws::check_derived(&t);
    let lost = 1.0 - cut_laws::volume(&t) / before.volume;
    assert!((0.0..0.005).contains(&lost), "{lost}");
}

#[test]
fn cut_keeps_the_displacement_field() {
    let t = topology([10, 10, 10], D);
    let bend = nalgebra::Matrix3::new(0.1, 0.2, 0.0, 0.0, -0.1, 0.05, 0.1, 0.0, 0.2);
    let bent = (0..t.node_count() as u32).map(|n| (n, bend * t.rest(n)));
    let mut tissue = Tissue::at_rest(t.clone());
    tissue.displace(&bent.collect::<Vec<_>>());
    let outcome = tissue
        .cut(&upright(
            [4.3 * D, -D],
            [6.1 * D, 11.0 * D],
            10.0 * D,
            6.0 * D,
        ))
        .unwrap();
    assert!(!outcome.moved.is_empty());
    let (t, displacement) = (tissue.topology(), &tissue.shape().displacement);
    assert_eq!(displacement.len(), t.node_count());
    // An affine deformation is unchanged at every node.
    for n in 0..t.node_count() as u32 {
        let off = displacement[n as usize] - bend * t.rest(n);
        assert!(off.norm() < 1e-9 * D, "node {n}: {}", off.norm() / D);
    }
}

#[test]
fn mapping_to_rest_inverts_the_deformation() {
    let t = topology([12, 12, 12], D);
    let mut shape = Shape::rest(&t);
    let press = |p: Vec3| Vec3::new(0.0, 0.3 * p.z, -0.25 * p.z * (p.x / (12.0 * D)).powi(2));
    for (i, u) in shape.displacement.iter_mut().enumerate() {
        *u = press(t.rest(i as u32));
    }
    for i in 0..500u32 {
        let f = |k: u32| f64::from(i * k % 97) / 97.0 * 12.0 * D;
        let rest = Vec3::new(f(13), f(29), f(41));
        let from = to_rest(&t, &shape, rest + press(rest)).unwrap();
        assert!(
            (from.position - rest).norm() < 0.05 * D,
            "{rest:?} {from:?}"
        );
        assert!(from.outside < 1e-9);
    }
    // Just above the surface, and far away.
    let top = Vec3::new(5.0 * D, 5.0 * D, 12.5 * D);
    let from = to_rest(&t, &shape, top + press(top)).unwrap();
    assert!((from.position - top).norm() < 0.3 * D && from.outside > 0.1);
    assert!(to_rest(&t, &shape, Vec3::repeat(1.0)).is_none());
    assert!(to_rest(&t, &shape, Vec3::repeat(f64::NAN)).is_none());
    // A point in the air keeps its height over cells that are squeezed to a third.
    let mut flat = Shape::rest(&t);
    for (i, u) in flat.displacement.iter_mut().enumerate() {
        let z = t.rest(i as u32).z;
        u.z = if z > 11.5 * D { -0.67 * D } else { 0.0 };
    }
    let air = Vec3::new(5.3 * D, 5.4 * D, 12.0 * D);
    let from = to_rest(&t, &flat, air).unwrap();
    assert!((from.position.z - 12.67 * D).abs() < 1e-9, "{from:?}");
    // A blade keeps its unit axis; its lengths are transformed.
    let blade = BladePoint {
        tip: Vec3::repeat(6.0 * D) + press(Vec3::repeat(6.0 * D)),
        axis: Vec3::z(),
        depth_m: 4.0 * D,
    };
    let at = blade.to_rest(&t, &shape).unwrap();
    assert!((at.axis.norm() - 1.0).abs() < 1e-12);
    assert!(at.depth_m > blade.depth_m);
}

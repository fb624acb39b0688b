//! A hierarchy that followed cuts is the one built for the cut topology, but for numbering.

use proptest::prelude::*;

use std::collections::BTreeSet;
use std::sync::Arc;

use super::super::cut_preparer::{Levels, TopologyCut};
use super::super::solver::Solver;
use super::super::weight::weights;
use super::*;
use crate::cut_history::CutHistory;
use crate::{BladePoint, CutStroke, Material, Shape, StrokePart, Vec3, block, cut};

const CELL: f64 = 4e-3;

/// Cells of each element of a level, sorted.
fn cells_of(topology: &Topology, hierarchy: &Hierarchy, l: usize) -> Vec<Vec<u32>> {
    let count = hierarchy.levels[l].corners.len() as u32;
    if l == 0 {
        let cells = &Construction::of(topology, hierarchy).cells;
        return (0..count).map(|e| cells.row(e).to_vec()).collect();
    }
    let below = cells_of(topology, hierarchy, l - 1);
    let of = |e: u32| {
        let children = hierarchy.levels[l].children.row(e).iter();
        let mut cells: Vec<u32> = children.flat_map(|c| below[*c as usize].clone()).collect();
        cells.sort_unstable();
        cells
    };
    (0..count).map(of).collect()
}

/// Asserts that the numbers of `a` can be mapped to those of `b` such that all data agree.
fn assert_same(topology: &Topology, a: &Hierarchy, b: &Hierarchy) {
    let nodes = topology.node_count() as u32;
    // A coarsest level that has split may be coarsened once more when it is built.
    assert!(a.levels.len() <= b.levels.len());
    let mut points: Vec<BTreeMap<u32, u32>> = Vec::new();
    let mut elements: Vec<BTreeMap<u32, u32>> = Vec::new();
    for (l, (x, y)) in a.levels.iter().zip(&b.levels).enumerate() {
        let known: BTreeMap<Vec<u32>, u32> =
            cells_of(topology, b, l).into_iter().zip(0..).collect();
        let of: BTreeMap<u32, u32> = (0..)
            .zip(cells_of(topology, a, l))
            .map(|(e, cells)| (e, known[&cells]))
            .collect();
        assert_eq!(of.len(), known.len(), "elements of level {l}");
        assert_eq!(x.points(), y.points(), "points of level {l}");
        let mut point_of = BTreeMap::new();
        for (&e, &f) in &of {
            let corners = x.corners[e as usize].iter().zip(&y.corners[f as usize]);
            for (&p, &q) in corners {
                assert_eq!(*point_of.entry(p).or_insert(q), q, "a point of level {l}");
            }
            assert_eq!(x.octant[e as usize], y.octant[f as usize]);
            let (m, n) = (x.element(e).1, y.element(f).1);
            let answers = [(x, e), (y, f)].map(|(level, e)| {
                let by = std::array::from_fn(|c| [c as f32, (c % 3) as f32, (c % 5) as f32, 0.0]);
                level.force(pulp::Scalar::new(), e, &by, Some(1.0))
            });
            let [m_force, n_force] = answers.each_ref().map(|of| of.as_flattened());
            let most = n_force.iter().fold(1.0f32, |most, v| most.max(v.abs()));
            for (m, n) in m_force.iter().zip(n_force) {
                assert!((m - n).abs() <= 1e-3 * most, "{m} and {n} of {most}");
            }
            for (m, n) in m.bound().iter().flatten().zip(n.bound().iter().flatten()) {
                assert!((m - n).abs() <= 1e-3 * n.abs().max(1.0), "{m} and {n}");
            }
        }
        let distinct: BTreeSet<u32> = point_of.values().copied().collect();
        assert_eq!(distinct.len(), point_of.len());
        for (&p, &q) in &point_of {
            let mapped: BTreeSet<u32> = x.around.row(p).iter().map(|e| of[e]).collect();
            let expected: BTreeSet<u32> = y.around.row(q).iter().copied().collect();
            assert_eq!(mapped, expected, "elements around a point of level {l}");
            for (m, n) in x.bound[p as usize].iter().zip(y.bound[q as usize]) {
                assert!((m - n).abs() <= 1e-3 * n.abs().max(1.0), "{m} and {n}");
            }
        }
        elements.push(of);
        points.push(point_of);
    }
    for l in 1..a.levels.len() {
        let (x, y) = (&a.levels[l - 1], &b.levels[l - 1]);
        for (&e, &f) in &elements[l - 1] {
            assert_eq!(elements[l][&x.parent[e as usize]], y.parent[f as usize]);
            assert!(a.levels[l].children.row(x.parent[e as usize]).contains(&e));
        }
        for (&p, &q) in &points[l - 1] {
            let row = |row: BTreeMap<u32, f32>| row;
            let mapped = x
                .prolongation
                .row(p as usize)
                .map(|(c, w)| (points[l][&c], w));
            assert_eq!(
                row(mapped.collect()),
                y.prolongation.row(q as usize).collect()
            );
        }
    }
    for n in 0..nodes {
        let mapped = a
            .prolongation
            .row(n as usize)
            .map(|(c, w)| (points[0][&c], w));
        let mapped: BTreeMap<u32, f32> = mapped.collect();
        assert_eq!(mapped, b.prolongation.row(n as usize).collect(), "node {n}");
        if let Some(e) = a.prolongation.element_of(n as usize) {
            assert!(
                a.nodes_of.row(e).contains(&n),
                "node {n} among those of its element"
            );
        }
        // Bricks may be numbered otherwise, but each node meets as many, with the same forms.
        let bricks = |h: &Hierarchy| -> Vec<(u128, u32)> {
            let of = |entry: &u32| {
                let brick = &h.bricks[(entry / 32) as usize];
                assert_eq!(brick.nodes[(entry % 32) as usize], n);
                (h.forms[brick.form as usize].key(), entry % 32)
            };
            let mut list: Vec<_> = h.around.row(n).iter().map(of).collect();
            list.sort_unstable();
            list
        };
        assert_eq!(bricks(a), bricks(b), "bricks around node {n}");
    }
    let followers = |h: &Hierarchy| -> usize {
        let elements = 0..h.levels[0].corners.len() as u32;
        elements.map(|e| h.nodes_of.row(e).len()).sum()
    };
    assert_eq!(followers(a), followers(b));
}

prop_compose! {
    fn stroke()(
        from in prop::array::uniform3(0.5..7.5f64),
        to in prop::array::uniform3(0.5..7.5f64),
        tilt in prop::array::uniform3(-0.6..0.6f64),
        depth in 1.0..8.0f64,
    ) -> CutStroke {
        let axis = (Vec3::z() + Vec3::from(tilt)).normalize();
        let (from, to) = (Vec3::from(from), Vec3::from(to));
        let point = |i: u32| BladePoint {
            tip: (from + (to - from) * (f64::from(i) / 6.0)) * CELL,
            axis,
            depth_m: depth * CELL,
        };
        CutStroke { points: (0..7).map(point).collect(), width_m: 0.0 }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn followed_hierarchy_is_the_built_one(strokes in prop::collection::vec(stroke(), 1..6)) {
        let model = block([8, 8, 8], CELL, &Material::default(), 1);
        let mut topology = Topology::new(Arc::new(model));
        let mut followed = Hierarchy::new(&topology);
        let mut construction = Construction::of(&topology, &followed);
        let mut applied = followed.clone();
        for stroke in strokes {
            if let Ok(outcome) = cut(&mut topology, &stroke).map(Arc::new) {
                let (change, _) = followed.follow(&mut construction, &topology, &outcome);
                applied.apply(&change);
                let built = Hierarchy::new(&topology);
                assert_same(&topology, &followed, &built);
                assert_same(&topology, &applied, &built);
                assert_derived(&construction, &topology, &followed);
            }
        }
    }

    /// Also after undos, redos and resets, which change the levels instead of building them.
    #[test]
    fn returned_hierarchy_is_the_built_one(
        steps in prop::collection::vec((0..9_u8, stroke(), 0..4_u64), 1..20),
    ) {
        let mut model = block([8, 8, 8], CELL, &Material::default(), 1);
        model.gravity = [0.0, 0.0, -1.0];
        let mut topology = Arc::new(Topology::new(Arc::new(model)));
        let mut history = CutHistory::new(Arc::clone(&topology));
        let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
        let mut preparer = solver.preparer(&topology, history.clone());
        for (step, stroke, number) in steps {
            let change = match step {
                0..=3 => {
                    // Parts of two strokes alternate.
                    let stroke = StrokePart::from(&stroke);
                    let number = (number < 2).then_some(number);
                    preparer.prepare(StrokePart { stroke: number, ..stroke }).ok()
                }
                4..=5 => preparer.undo().map(TopologyCut::finish),
                6..=7 => preparer.redo().and_then(Result::ok).map(TopologyCut::finish),
                _ => preparer.reset().map(TopologyCut::finish),
            };
            let Some(change) = change else { continue };
            assert!(matches!(change.levels, Levels::Changed(_)));
            solver.succeed(&mut topology, &mut history, &mut shape, change);
            let built = Hierarchy::new(&topology);
            assert_same(&topology, &preparer.hierarchy, &built);
            assert_same(&topology, &solver.hierarchy, &built);
            assert_derived(&preparer.construction, &topology, &preparer.hierarchy);
            assert_eq!(shape.displacement.len(), topology.node_count());
            assert_eq!(solver.fine.weights, weights(&topology));
        }
    }
}

/// Also where the history has no copy of the topology any more and repeats strokes.
#[test]
fn undos_of_many_strokes_build_no_levels() {
    let model = block([40, 4, 4], CELL, &Material::default(), 1);
    let mut topology = Arc::new(Topology::new(Arc::new(model)));
    let mut history = CutHistory::new(Arc::clone(&topology));
    let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
    let mut preparer = solver.preparer(&topology, history.clone());
    let mut counts = Vec::new();
    for x in 0..12 {
        let point = |y: u32| BladePoint {
            tip: Vec3::new(2.4 + 3.1 * f64::from(x), f64::from(y), 1.2) * CELL,
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        counts.push(topology.node_count());
        let points = (0..5).map(point).collect();
        let width_m = 0.0;
        let cut = preparer.prepare(&CutStroke { points, width_m }).unwrap();
        solver.succeed(&mut topology, &mut history, &mut shape, cut);
    }
    for (n, u) in shape.displacement.iter_mut().enumerate() {
        u.x = 1e-6 * n as f64;
    }
    let displaced = shape.clone();
    while let Some(undone) = preparer.undo().map(TopologyCut::finish) {
        assert!(matches!(undone.levels, Levels::Changed(_)));
        solver.succeed(&mut topology, &mut history, &mut shape, undone);
        assert_same(&topology, &solver.hierarchy, &Hierarchy::new(&topology));
        assert_eq!(topology.node_count(), counts.pop().unwrap());
        let kept = &displaced.displacement[..topology.node_count()];
        assert_eq!(shape.displacement, kept);
    }
    assert_eq!(counts, []);
}

/// Asserts that followed data are those derived from the hierarchy.
fn assert_derived(construction: &Construction, topology: &Topology, hierarchy: &Hierarchy) {
    let derived = Construction::of(topology, hierarchy);
    assert_eq!(construction.cells.rows(), derived.cells.rows());
    for e in 0..hierarchy.levels[0].corners.len() as u32 {
        assert_eq!(construction.cells.row(e), derived.cells.row(e));
    }
    assert_eq!(construction.element_of, derived.element_of);
    for (known, derived) in construction.places.iter().zip(&derived.places) {
        assert_eq!(known.of, derived.of);
    }
    construction.kinds.assert_same(&derived.kinds);
}

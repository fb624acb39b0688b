//! The surfaces that the strokes in effect have swept, in a tree of boxes over the parts of strokes.
//!
//! The parts are, in order, the leaves of perfect binary trees of descending height, as the binary digits of their number
//! give; finished strokes are the leaves of further ones, so that no box is around the end of one stroke and the begin of another. A
//! part is added, and the last ones are removed, in logarithmic time, and copies share all trees.

use std::sync::Arc;

use super::StrokePart;
use super::ribbon::{Bounds, Triangle};
use super::stroke::BladePoint;
use crate::Vec3;

/// Farthest point beside a swept surface that counts as on it, in spacings: a lattice parts no tissue nearer to a wound,
/// because the centres of the cells there are as far.
const WALL: f64 = 0.5;
/// Farthest point beyond the rims of a swept surface that counts as on it, in spacings: at a fold between two steps, the foot of a
/// point beside the surface is as far beyond the rims of both.
const RIM: f64 = 0.1;
/// Farthest foot on a surface of a point that is on it, in spacings.
pub(super) const REACH: f64 = WALL + RIM;
/// Least cosine of the angle between two surfaces of one cut, that of 30 degrees.
const ALONG: f64 = 0.866;

/// The swept surfaces of strokes.
#[derive(Debug, Clone, Default)]
pub(crate) struct StrokeTree {
    /// Those of finished strokes first, of either kind the highest first.
    trees: Vec<Tree>,
}

#[derive(Debug, Clone)]
struct Tree {
    /// Finished strokes; 0 for parts of a stroke.
    strokes: usize,
    parts: usize,
    node: Arc<Node>,
}

#[derive(Debug)]
struct Node {
    bounds: Bounds,
    below: Below,
}

impl Tree {
    /// Makes one tree of the last two of a list, if those are to be joined. Returns whether they are.
    fn join_last(trees: &mut Vec<Self>, joins: impl Fn(&Self, &Self) -> bool) -> bool {
        let [.., a, b] = &trees[..] else {
            return false;
        };
        if !joins(a, b) {
            return false;
        }
        let halves = [a.clone(), b.clone()];
        trees.truncate(trees.len() - 2);
        trees.push(Self {
            strokes: halves.iter().map(|half| half.strokes).sum(),
            parts: halves.iter().map(|half| half.parts).sum(),
            node: Arc::new(Node {
                bounds: halves[0].node.bounds.with(&halves[1].node.bounds),
                below: Below::Trees(halves),
            }),
        });
        true
    }
}

#[derive(Debug)]
enum Below {
    Part(SweptPart),
    Trees([Tree; 2]),
}

/// A part of a stroke, and the blade at the end of the part before, from where it moved on.
#[derive(Debug)]
pub(crate) struct SweptPart {
    bounds: Bounds,
    joint: Option<BladePoint>,
    part: Arc<StrokePart>,
}

impl SweptPart {
    fn points(&self) -> impl Iterator<Item = &BladePoint> + Clone {
        self.joint.iter().chain(&self.part.path.points)
    }

    /// Whether a point is on its surface, and a surface with this normal there is along it.
    pub(crate) fn is_along(&self, at: &Vec3, normal: &Vec3, spacing: f64) -> bool {
        let near = Bounds::around([*at].into_iter()).grown(REACH * spacing);
        if !self.bounds.overlaps(&near) {
            return false;
        }
        let mut steps = self.points().zip(self.points().skip(1));
        steps.any(|(from, to)| {
            let ends = [from, to].into_iter().flat_map(BladePoint::ends);
            if !Bounds::around(ends).overlaps(&near) {
                return false;
            }
            let mut triangles = Triangle::swept([from, to], spacing);
            triangles.any(|triangle| {
                triangle.normal.dot(normal).abs() >= ALONG
                    && triangle.height(at).abs() <= WALL * spacing
                    && triangle.beside(at) <= RIM * spacing
            })
        })
    }
}

impl StrokeTree {
    /// Adds the part of a stroke after those `before`.
    pub(crate) fn push(&mut self, part: &Arc<StrokePart>, before: &[Arc<StrokePart>]) {
        let mut swept = SweptPart {
            bounds: Bounds::EMPTY,
            joint: part.joint(before),
            part: Arc::clone(part),
        };
        swept.bounds = Bounds::around(swept.points().flat_map(BladePoint::ends));
        if swept.joint.is_none() {
            self.finish();
        }
        self.trees.push(Tree {
            strokes: 0,
            parts: 1,
            node: Arc::new(Node {
                bounds: swept.bounds,
                below: Below::Part(swept),
            }),
        });
        let is_alike = |a: &Tree, b: &Tree| a.strokes == 0 && a.parts == b.parts;
        while Tree::join_last(&mut self.trees, is_alike) {}
    }

    /// Makes one tree of the parts of the latest stroke.
    fn finish(&mut self) {
        while Tree::join_last(&mut self.trees, |a, _| a.strokes == 0) {}
        if let Some(last) = self.trees.last_mut() {
            last.strokes = last.strokes.max(1);
        }
        while Tree::join_last(&mut self.trees, |a, b| a.strokes == b.strokes) {}
    }

    /// Removes all but the first parts.
    pub(crate) fn truncate(&mut self, parts: usize) {
        let all: usize = self.trees.iter().map(|tree| tree.parts).sum();
        let mut excess = all.saturating_sub(parts);
        while excess > 0
            && let Some(last) = self.trees.pop()
        {
            match &last.node.below {
                Below::Trees(halves) if last.parts > excess => {
                    self.trees.extend(halves.iter().cloned());
                }
                _ => excess -= last.parts,
            }
        }
    }

    /// The parts whose boxes overlap any of these.
    pub(crate) fn near(&self, boxes: &[Bounds]) -> Vec<&SweptPart> {
        let mut near = Vec::new();
        let mut open: Vec<&Node> = self.trees.iter().map(|tree| tree.node.as_ref()).collect();
        while let Some(node) = open.pop() {
            if !boxes.iter().any(|bounds| node.bounds.overlaps(bounds)) {
                continue;
            }
            match &node.below {
                Below::Part(part) => near.push(part),
                Below::Trees(halves) => open.extend(halves.iter().map(|half| half.node.as_ref())),
            }
        }
        near
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::CutStroke;

    fn part([x, y]: [f64; 2], stroke: u64, joins: bool) -> Arc<StrokePart> {
        let blade = |x: f64| BladePoint {
            tip: Vec3::new(x, y, 0.0),
            axis: Vec3::z(),
            depth_m: 1.0,
        };
        Arc::new(StrokePart {
            path: CutStroke {
                points: vec![blade(x), blade(x + 0.5)],
                width_m: 0.0,
            },
            stroke: Some(stroke),
            joins,
        })
    }

    proptest! {
        /// After any additions and removals; copies of the tree stay as they were.
        #[test]
        fn tree_finds_the_parts_in_boxes(
            steps in prop::collection::vec((prop::array::uniform2(0.0..10.0f64), 0_u64..3, any::<bool>(), 0_usize..8), 1..80),
            (places, size) in (prop::collection::vec(prop::array::uniform2(0.0..10.0f64), 1..4), 0.0..2.0f64),
        ) {
            let around = |[x, y]: &[f64; 2]| Bounds::around([Vec3::new(*x, *y, 0.5)].into_iter()).grown(size);
            let boxes: Vec<Bounds> = places.iter().map(around).collect();
            let (mut tree, mut parts) = (StrokeTree::default(), Vec::new());
            let mut copies = Vec::new();
            for (place, stroke, joins, removed) in steps {
                let part = part(place, stroke, joins);
                tree.push(&part, &parts);
                parts.push(part);
                if removed == 0 {
                    copies.push((tree.clone(), parts.clone()));
                } else if removed > 4 {
                    parts.truncate(parts.len().saturating_sub(removed - 4));
                    tree.truncate(parts.len());
                }
            }
            copies.push((tree, parts));
            for (tree, parts) in copies {
                prop_assert!(tree.trees.len() <= 2 * (parts.len() + 1).ilog2() as usize + 2);
                let mut found: Vec<_> = tree.near(&boxes).iter().map(|p| Arc::as_ptr(&p.part)).collect();
                let is_near = |i: &usize| {
                    let ends = parts[*i].joint(&parts[..*i]).into_iter().chain(parts[*i].path.points.iter().copied());
                    let bounds = Bounds::around(ends.flat_map(|blade| blade.ends()));
                    boxes.iter().any(|near| bounds.overlaps(near))
                };
                let mut expected: Vec<_> = (0..parts.len()).filter(is_near).map(|i| Arc::as_ptr(&parts[i])).collect();
                found.sort_unstable();
                expected.sort_unstable();
                prop_assert_eq!(found, expected);
            }
        }
    }
}

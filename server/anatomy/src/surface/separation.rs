//! Separating triangles that pass through each other by planes.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;

/// Sines of angles below this are zero: two edges are parallel.
const PARALLEL: f64 = 1e-9;

/// The step of each corner of some pairs of triangles: the mean of those that separate its pairs.
pub(crate) fn separations(
    pairs: impl Iterator<Item = [[u32; 3]; 2]>,
    place: impl Fn(u32) -> Vec3,
    margin: f64,
) -> Vec<(u32, Vec3)> {
    let mut sums: BTreeMap<u32, (Vec3, f64)> = BTreeMap::new();
    for (node, by) in pairs.flat_map(|pair| separation(pair, &place, margin)) {
        let sum = sums.entry(node).or_default();
        sum.0 += by;
        sum.1 += 1.0;
    }
    let means = sums.into_iter();
    means
        .map(|(node, (sum, count))| (node, sum / count))
        .collect()
}

/// Steps of the corners of two triangles that end `margin` beyond a plane, on their own sides. Of the directions of the
/// separating axis theorem (the normals, and the products of two edges), the plane has the one in which the triangles
/// overlap least. A common corner lies in the plane and stays; with two common corners there is no step.
fn separation(
    triangles: [[u32; 3]; 2],
    place: impl Fn(u32) -> Vec3,
    margin: f64,
) -> Vec<(u32, Vec3)> {
    let places = triangles.map(|t| t.map(&place));
    let [a, b] = places
        .map(|[p, q, r]| [q - p, r - q, p - r].map(|e| e.try_normalize(0.0).unwrap_or_default()));
    let crossed = a.iter().flat_map(|p| b.iter().map(move |q| p.cross(q)));
    let normals = [a, b].map(|edges| edges[0].cross(&edges[1]));
    let axes = normals.into_iter().chain(crossed);
    let axes = axes.filter_map(|axis| axis.try_normalize(PARALLEL));
    let mut common = triangles[0].iter().filter(|n| triangles[1].contains(n));
    let shared = common.next().map(|n| place(*n));
    if common.next().is_some() {
        return Vec::new();
    }
    let overlap = |axis: &Vec3| {
        let [below, above] = places.map(|t| t.map(|p| p.dot(axis)));
        let highest = below.into_iter().fold(f64::NEG_INFINITY, f64::max);
        let lowest = above.into_iter().fold(f64::INFINITY, f64::min);
        (highest - lowest, f64::midpoint(highest, lowest))
    };
    let axes = axes.flat_map(|axis| [axis, -axis]);
    let least = axes
        .map(|axis| (axis, overlap(&axis)))
        .min_by(|p, q| p.1.0.total_cmp(&q.1.0));
    let Some((axis, (_, middle))) = least else {
        return Vec::new();
    };
    let level = shared.map_or(middle, |p| p.dot(&axis));
    let mut steps = Vec::new();
    for (own, other, up) in [(0, 1, -1.0), (1, 0, 1.0)] {
        for node in triangles[own] {
            let lacks = margin - (place(node).dot(&axis) - level) * up;
            if lacks > 0.0 && !triangles[other].contains(&node) {
                steps.push((node, axis * (up * lacks)));
            }
        }
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::super::crossings;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn triangles_do_not_cross_after_their_steps(
            corners in prop::collection::vec(prop::array::uniform3(-1.0_f64..1.0), 6),
            common in any::<bool>(),
        ) {
            let mut places: Vec<Vec3> = corners.into_iter().map(Vec3::from).collect();
            let triangles = [[0, 1, 2], [if common { 0 } else { 3 }, 4, 5]];
            let cross = |places: &[Vec3]| !crossings(&triangles, |n| places[n as usize], 1.0).is_empty();
            prop_assume!(cross(&places));
            let before = places.clone();
            for (node, by) in separation(triangles, |n| before[n as usize], 0.01) {
                places[node as usize] += by;
            }
            prop_assert!(!cross(&places), "{before:?} {places:?}");
            prop_assert!(!common || places[0] == before[0]);
        }
    }
}

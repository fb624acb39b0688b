//! The part of a triangle nearest to a point (Ericson 2005, Real-Time Collision Detection, 5.1.5).

use crate::Vec3;

/// A part of a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Feature {
    /// One of its corners.
    Corner(usize),
    /// The edge between two corners, at this part of the way from the first to the second.
    Edge(usize, usize, f64),
    /// Its inside: barycentric weights before division by their sum.
    Face([f64; 3]),
}

/// The part of a triangle nearest to `p`.
pub fn nearest_feature(p: &Vec3, [a, b, c]: &[Vec3; 3]) -> Feature {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return Feature::Corner(0);
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return Feature::Corner(1);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 > d3 {
        return Feature::Edge(0, 1, d1 / (d1 - d3));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return Feature::Corner(2);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 && d2 > d6 {
        return Feature::Edge(0, 2, d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    let (e, f) = (d4 - d3, d5 - d6);
    if va <= 0.0 && e >= 0.0 && f >= 0.0 && e + f > 0.0 {
        return Feature::Edge(1, 2, e / (e + f));
    }
    Feature::Face([va, vb, vc])
}

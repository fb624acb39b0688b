//! The direction of a drawing, and the faces of a surface seen in it.

use palpate_tissue::cell::FACES;
use palpate_tissue::{FaceId, Shape, Topology, Vec3};

use super::section::{MM, Point};

/// An orthographic view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    right: Vec3,
    up: Vec3,
    /// Towards the viewer.
    towards: Vec3,
}

impl View {
    /// The view from a direction, with another one as upright as it allows.
    pub fn from(towards: Vec3, up: Vec3) -> Self {
        let right = up.cross(&towards).normalize();
        let towards = towards.normalize();
        Self {
            right,
            up: towards.cross(&right),
            towards,
        }
    }

    /// The view along an axis of the model: x to the right and z up where they exist.
    pub fn along(axis: usize) -> Self {
        // With x to the right and z up, the viewer stands at negative y.
        let [towards, up] = [
            [Vec3::x(), Vec3::z()],
            [-Vec3::y(), Vec3::z()],
            [Vec3::z(), Vec3::y()],
        ][axis];
        Self::from(towards, up)
    }

    /// Projection of a point, in mm.
    pub(super) fn flat(&self, p: &Vec3) -> Point {
        [p.dot(&self.right) * MM, p.dot(&self.up) * MM]
    }

    /// How bright a face with this normal is, from 0 to 1: light comes from the upper left of the viewer.
    pub(super) fn brightness(&self, normal: &Vec3) -> f64 {
        let light = (self.towards + 0.5 * self.up - 0.35 * self.right).normalize();
        let cosine = normal.try_normalize(0.0).map_or(0.0, |n| n.dot(&light));
        0.62 + 0.38 * cosine.max(0.0)
    }
}

/// A face of a surface with its outward normal, of the length of its area.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenFace {
    pub(super) face: FaceId,
    pub(super) nodes: [u32; 4],
    pub(super) corners: [Vec3; 4],
    pub(super) area: Vec3,
}

impl SeenFace {
    pub(super) fn of(topology: &Topology, shape: &Shape, face: FaceId) -> Self {
        let cell = topology.corners(face.cell());
        let nodes = FACES[face.face()].map(|i| cell[i]);
        let corners = nodes.map(|n| shape.position(topology, n));
        let [a, b, c, d] = corners;
        Self {
            face,
            nodes,
            corners,
            area: (c - a).cross(&(d - b)) * 0.5,
        }
    }

    pub(super) fn centre(&self) -> Vec3 {
        self.corners.iter().sum::<Vec3>() / 4.0
    }
}

/// The faces that look to the viewer, nearer ones after farther ones.
pub(super) fn seen(faces: impl IntoIterator<Item = SeenFace>, view: &View) -> Vec<SeenFace> {
    let faces = faces.into_iter();
    let mut seen: Vec<SeenFace> = faces.filter(|f| f.area.dot(&view.towards) > 0.0).collect();
    let near = |f: &SeenFace| f.centre().dot(&view.towards);
    seen.sort_by(|a, b| near(a).total_cmp(&near(b)));
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{Material, block};

    #[test]
    fn seen_area_is_the_silhouette_and_near_faces_are_last() {
        let topology = Topology::new(block([3, 4, 5], 0.01, &Material::default(), 1).into());
        let shape = Shape::rest(&topology);
        let faces = || {
            let all = topology.boundary().faces.iter();
            all.map(|&f| SeenFace::of(&topology, &shape, f))
        };
        for (axis, silhouette) in [(0, 20e-4), (1, 15e-4), (2, 12e-4)] {
            let view = View::along(axis);
            let shown = seen(faces(), &view);
            let area: f64 = shown.iter().map(|f| f.area.dot(&view.towards)).sum();
            assert!((area / silhouette - 1.0).abs() < 1e-9, "{axis}: {area}");
        }
        let view = View::from(Vec3::new(1.0, -2.0, 1.5), Vec3::z());
        let shown = seen(faces(), &view);
        let area: f64 = shown.iter().map(|f| f.area.dot(&view.towards)).sum();
        // Cauchy: each pair of sides shows its area times the cosine of its angle.
        let expected = (20.0 * 1.0 + 15.0 * 2.0 + 12.0 * 1.5) * 1e-4 / 7.25_f64.sqrt();
        assert!((area / expected - 1.0).abs() < 1e-9, "{area}");
        let heights: Vec<f64> = shown
            .iter()
            .map(|f| f.centre().dot(&view.towards))
            .collect();
        assert!(heights.is_sorted());
    }
}

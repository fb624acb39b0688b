//! Random strokes that enter a model through its surface: planes and curves, leaning and turning.

use palpate_tissue::{BladePoint, CutStroke, Topology, Vec3};
use rand::RngExt;
use rand_pcg::Pcg64;

/// Distance of blade points in m.
const STEP_M: f64 = 1e-3;

fn direction(random: &mut Pcg64) -> Vec3 {
    loop {
        let v = Vec3::from_fn(|_, _| random.random_range(-1.0..1.0));
        if (0.1..1.0).contains(&v.norm()) {
            return v.normalize();
        }
    }
}

/// A stroke of a closed cut from a random place of the outer surface. Half of the strokes are plane; the others turn by
/// up to a radian and lean more on the way. Lengths are 4 to 14 spacings, depths 1.5 to 8.
pub(crate) fn random_stroke(topology: &Topology, random: &mut Pcg64) -> CutStroke {
    let spacing = topology.model().spacing_m;
    let triangles = &topology.boundary().triangles;
    let (at, out) = loop {
        let [a, b, c] =
            triangles[random.random_range(0..triangles.len())].map(|n| topology.rest(n));
        let normal = (b - a).cross(&(c - a));
        if normal.norm() > 1e-3 * spacing * spacing {
            break ((a + b + c) / 3.0, normal.normalize());
        }
    };
    let mut axis = (out + direction(random) * 0.9).normalize();
    let mut way = out.cross(&direction(random));
    while way.norm() < 0.2 {
        way = out.cross(&direction(random));
    }
    let mut way = way.normalize();
    let is_plane = random.random_bool(0.5);
    let depth_m = random.random_range(1.5..8.0) * spacing;
    let steps = (random.random_range(4.0..14.0) * spacing / STEP_M).ceil();
    let (turn, lean) = if is_plane {
        (0.0, 0.0)
    } else {
        (
            random.random_range(-1.0..1.0),
            random.random_range(-0.5..0.5),
        )
    };
    let outside = 1.5 * spacing;
    let mut top = at;
    let mut points = Vec::new();
    for _ in 0..=steps as usize {
        points.push(BladePoint {
            tip: top - axis * depth_m,
            axis,
            depth_m: depth_m + outside,
        });
        top += way * STEP_M;
        let rotate = |v: Vec3, about: Vec3, angle: f64| v + about.cross(&v) * angle;
        way = rotate(way, axis, turn / steps).normalize();
        axis = rotate(axis, way, lean / steps).normalize();
    }
    CutStroke {
        points,
        width_m: 0.0,
    }
}

/// A plane stroke through the middle of another one, at 30 to 150 degrees to it, leaning by up to 20 degrees.
pub(crate) fn crossing_stroke(other: &CutStroke, spacing: f64, random: &mut Pcg64) -> CutStroke {
    let [first, .., last] = &other.points[..] else {
        unreachable!("a random stroke has many points");
    };
    let middle = other.points[other.points.len() / 2];
    let along = (last.tip - first.tip).normalize();
    let side = middle.axis.cross(&along).normalize();
    let angle = random.random_range(0.52..2.62f64);
    let way = along * angle.cos() + side * angle.sin();
    let lean = random.random_range(-0.35..0.35);
    let axis = (middle.axis + middle.axis.cross(&way).normalize() * lean).normalize();
    let depth_m = middle.depth_m * random.random_range(0.6..1.3);
    let steps = (random.random_range(6.0..14.0) * spacing / STEP_M).ceil();
    let shift = random.random_range(0.3..0.7);
    let point = |i: usize| BladePoint {
        tip: middle.top() - axis * depth_m + way * ((i as f64 - shift * steps) * STEP_M),
        axis,
        depth_m,
    };
    CutStroke {
        points: (0..=steps as usize).map(point).collect(),
        width_m: 0.0,
    }
}

/// The same stroke in pieces of `length_m`, each with the path of three spacings before it.
pub(crate) fn pieces(stroke: &CutStroke, length_m: f64, spacing: f64) -> Vec<CutStroke> {
    let new = (length_m / STEP_M).round().max(1.0) as usize;
    let overlap = (3.0 * spacing / STEP_M).ceil() as usize;
    let last = stroke.points.len() - 1;
    let ends = (0..).map(|i| (i + 1) * new).take_while(|e| *e < last + new);
    ends.map(|end| {
        let end = end.min(last);
        let start = end.saturating_sub(new + overlap);
        CutStroke {
            points: stroke.points[start..=end].to_vec(),
            ..stroke.clone()
        }
    })
    .collect()
}

//! A segment of a right thigh, 200 mm of its length, like a casting of a phantom: its ends are rounded and
//! closed by subcutaneous tissue.
//!
//! X points to the lateral side, Y to the front, Z up the leg. The outermost region is
//! subcutaneous fat and holds the skin too, whose 2 mm are thinner than the spacing of 4 mm.
//! The muscle groups lie around the femur as in a section through the middle of the thigh: quadriceps in front,
//! hamstrings behind, adductors on the medial side. They touch each other, and fat fills the rest.

use std::f64::consts::PI;

use super::loft::{End, Loft, Point, distance_to_line, rounded_min};
use super::{Body, Part};

const LENGTH_MM: f64 = 200.0;
/// Triangles of about this size: the spacing of the default scene.
const STEP_MM: f64 = 4.0;
/// Half of the overlap of two muscle groups where they touch; the later one wins. A cleft thinner than the
/// spacing could not be divided, and would leave crushed cells.
const OVERLAP_MM: f64 = 1.0;
/// Distance of the ends of the medullary cavity from the ends of the bone.
const MARROW_INSET_MM: f64 = 8.0;

/// Height along the segment, 0 at the knee's end and 1 at the hip's.
fn t(z: f64) -> f64 {
    z / LENGTH_MM
}

/// The skin.
fn envelope() -> Loft<'static> {
    Loft {
        z: [0.0, LENGTH_MM],
        ends: [End::Fillet(14.0); 2],
        centre: Box::new(|z| [3.0 * (PI * t(z)).sin(), 2.0 - 4.0 * t(z)]),
        radius: Box::new(|z, theta| {
            let [a, b] = [62.0 + 19.0 * t(z), 65.0 + 18.0 * t(z)];
            let ellipse = a * b / (b * theta.cos()).hypot(a * theta.sin());
            // Fuller behind and on the medial side, flatter outside.
            let asymmetry = 0.03 * (theta - 3.9).cos() + 0.015 * (3.0 * theta + 0.7).cos();
            ellipse * (1.0 + asymmetry)
        }),
    }
}

/// Subcutaneous tissue is thickest on the medial side.
fn fat_mm(theta: f64) -> f64 {
    8.0 + 2.5 * (1.0 - theta.cos())
}

/// The shaft runs obliquely from the hip's outside towards the middle of the knee.
fn femur_centre(z: f64) -> Point {
    [
        6.0 + 10.0 * t(z),
        5.0 - 2.0 * t(z) + 3.0 * (PI * t(z)).sin(),
    ]
}

/// A round shaft with a ridge behind, the linea aspera.
fn femur_radius(theta: f64) -> f64 {
    13.5 + 1.8 * (4.0 * ((theta + 0.5 * PI).cos() - 1.0)).exp()
}

/// A muscle group: its middle, seen from the femur (angle and mm), and the walls that separate it from its
/// neighbours: angle of the outward normal, mm from the femur's axis along it.
struct Group {
    middle: [f64; 2],
    walls: &'static [[f64; 2]],
    z: [f64; 2],
}

/// Normal of the wall between the quadriceps and the groups behind it.
const FRONT: f64 = 1.22;
/// Normal of the wall between hamstrings and adductors, towards the adductors.
const MEDIAL: f64 = 2.53;

const QUADRICEPS: Group = Group {
    middle: [FRONT, 24.0],
    walls: &[[FRONT + PI, 8.0 + OVERLAP_MM]],
    z: [7.0, 194.0],
};
const HAMSTRINGS: Group = Group {
    middle: [4.97, 40.0],
    walls: &[[FRONT, -8.0 + OVERLAP_MM], [MEDIAL, OVERLAP_MM]],
    z: [6.0, 193.0],
};
const ADDUCTORS: Group = Group {
    middle: [3.46, 38.0],
    walls: &[[FRONT, -8.0 + OVERLAP_MM], [MEDIAL + PI, OVERLAP_MM]],
    z: [12.0, 195.0],
};

impl Group {
    /// The muscle fills the space within the fat, its walls and its own roundness.
    fn loft<'a>(&'a self, envelope: &'a Loft<'static>) -> Loft<'a> {
        let middle = |z: f64| {
            let f = femur_centre(z);
            let [angle, distance] = self.middle;
            let distance = distance * (0.85 + 0.2 * t(z));
            [f[0] + distance * angle.cos(), f[1] + distance * angle.sin()]
        };
        Loft {
            z: self.z,
            ends: [End::Dome(22.0); 2],
            centre: Box::new(middle),
            radius: Box::new(move |z, theta| {
                let from = middle(z);
                let femur = femur_centre(z);
                let walls = self.walls.iter().map(|&[normal, distance]| {
                    let on = [
                        femur[0] + distance * normal.cos(),
                        femur[1] + distance * normal.sin(),
                    ];
                    distance_to_line(from, theta, on, normal)
                });
                let skin = envelope.distance(z, from, theta, fat_mm);
                rounded_min(walls.chain([skin]))
            }),
        }
    }
}

/// The sample with all its regions.
pub(super) fn body() -> Body {
    let envelope = envelope();
    let part = |name, material, loft: &Loft| Part {
        name,
        material,
        surface: loft.surface(STEP_MM),
    };
    let femur = Loft {
        z: [5.0, LENGTH_MM - 5.0],
        ends: [End::Fillet(4.0); 2],
        centre: Box::new(femur_centre),
        radius: Box::new(|_, theta| femur_radius(theta)),
    };
    let marrow = Loft {
        z: [5.0 + MARROW_INSET_MM, LENGTH_MM - 5.0 - MARROW_INSET_MM],
        ends: [End::Dome(6.0); 2],
        centre: Box::new(femur_centre),
        radius: Box::new(|_, _| 6.8),
    };
    Body {
        spacing_m: 4e-3,
        pinned: &["femur"],
        parts: vec![
            part("subcutaneous", "fat", &envelope),
            part("quadriceps", "muscle", &QUADRICEPS.loft(&envelope)),
            part("hamstrings", "muscle", &HAMSTRINGS.loft(&envelope)),
            part("adductors", "muscle", &ADDUCTORS.loft(&envelope)),
            part("femur", "bone", &femur),
            // Yellow marrow is fat.
            part("marrow", "fat", &marrow),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::super::loft::tests::integral;
    use super::*;

    #[test]
    fn part_volumes_are_the_integrals_of_their_sections() {
        let skin = envelope();
        for loft in [QUADRICEPS, HAMSTRINGS, ADDUCTORS]
            .iter()
            .map(|g| g.loft(&skin))
        {
            let error = loft.surface(STEP_MM).volume() * 1e9 / integral(&loft) - 1.0;
            assert!(error.abs() < 0.01, "{error}");
        }
        let error = skin.surface(STEP_MM).volume() * 1e9 / integral(&skin) - 1.0;
        assert!(error.abs() < 2e-3, "{error}");
    }
}

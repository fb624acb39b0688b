//! A right lower leg between ankle and knee, 260 mm of its length, its ends rounded and closed
//! by subcutaneous tissue.
//!
//! X points to the lateral side, Y to the front, Z up the leg. The outermost region is
//! subcutaneous fat and holds the skin too, whose 2 mm are thinner than the spacing of 4 mm. The
//! crest of the tibia lies close below the skin of the shin, as it does in life.

use std::f64::consts::{FRAC_PI_2, PI};

use super::loft::{End, Loft, Point, bell, distance_to_line, rounded_min, smooth_step};
use super::{Body, Part};

const LENGTH_MM: f64 = 260.0;
/// Triangles of about this size: the spacing of the default scene.
const STEP_MM: f64 = 4.0;
/// Tissue between the crest of the tibia and the air.
const SHIN_MM: f64 = 6.0;

/// Height along the leg, 0 at the ankle and 1 at the knee.
fn t(z: f64) -> f64 {
    z / LENGTH_MM
}

/// The belly of the calf: 1 where it is fullest.
fn calf_belly(z: f64) -> f64 {
    bell(t(z), 0.68, 0.22)
}

fn envelope_centre(z: f64) -> Point {
    [0.0, -7.0 * calf_belly(z)]
}

fn envelope_radius(z: f64, theta: f64) -> f64 {
    let round = 36.0 + 11.0 * smooth_step(0.0, 0.6, t(z)) + 7.0 * calf_belly(z);
    let back = 0.04 * calf_belly(z) * (theta + FRAC_PI_2).cos();
    round * (1.0 + back + 0.015 * (3.0 * theta).sin())
}

/// The skin.
fn envelope() -> Loft<'static> {
    Loft {
        z: [0.0, LENGTH_MM],
        ends: [End::Fillet(10.0); 2],
        centre: Box::new(envelope_centre),
        radius: Box::new(envelope_radius),
    }
}

/// A rounded triangle with an edge to the front, wider towards the knee.
fn tibia_radius(z: f64, theta: f64) -> f64 {
    let size = 11.0 + 5.0 * smooth_step(0.5, 1.0, t(z)) + 1.5 * smooth_step(0.2, 0.0, t(z));
    size * (1.0 + 0.13 * (3.0 * (theta - FRAC_PI_2)).cos())
}

/// Beside the middle, as far to the front as the skin of the shin leaves room.
fn tibia_centre(z: f64) -> Point {
    let x = -5.0;
    let c = envelope_centre(z);
    let front = envelope_radius(z, FRAC_PI_2) + c[1];
    [x, front - SHIN_MM - tibia_radius(z, FRAC_PI_2)]
}

/// On the lateral side, behind the tibia.
fn fibula_centre(z: f64) -> Point {
    let c = envelope_centre(z);
    let tibia = tibia_centre(z);
    [c[0] + 0.56 * envelope_radius(z, 0.0), tibia[1] - 18.0]
}

/// Angle of the direction that is square to the line from tibia to fibula, to the front.
fn front(z: f64) -> f64 {
    let [tibia, fibula] = [tibia_centre(z), fibula_centre(z)];
    (fibula[1] - tibia[1]).atan2(fibula[0] - tibia[0]) + FRAC_PI_2
}

/// A muscle group before or behind the membrane between the bones: `turn` is the angle from the
/// front to it, `inset_mm` the fat outside it.
fn group<'a>(envelope: &'a Loft<'static>, turn: f64, inset_mm: f64) -> Loft<'a> {
    let between = |z: f64| {
        let [tibia, fibula] = [tibia_centre(z), fibula_centre(z)];
        [0.5 * (tibia[0] + fibula[0]), 0.5 * (tibia[1] + fibula[1])]
    };
    // Half way from the membrane to the skin.
    let middle = move |z: f64| {
        let (from, angle) = (between(z), front(z) + turn);
        let distance = 0.5 * envelope.distance(z, from, angle, |_| inset_mm);
        [
            from[0] + distance * angle.cos(),
            from[1] + distance * angle.sin(),
        ]
    };
    Loft {
        z: [10.0, LENGTH_MM - 10.0],
        ends: [End::Dome(30.0); 2],
        centre: Box::new(middle),
        radius: Box::new(move |z, theta| {
            let from = middle(z);
            // The wall's normal points away from the group. Both groups reach 1 mm beyond it, so
            // that no cleft thinner than the spacing is left between them.
            let normal = front(z) + turn + PI;
            let membrane = between(z);
            let on = [membrane[0] + normal.cos(), membrane[1] + normal.sin()];
            // In front, muscle lies on the lateral side of the tibia only.
            let medial = (turn == 0.0).then(|| distance_to_line(from, theta, tibia_centre(z), PI));
            let membrane = distance_to_line(from, theta, on, normal);
            let skin = envelope.distance(z, from, theta, |_| inset_mm);
            rounded_min([skin, membrane].into_iter().chain(medial))
        }),
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
    let calf = group(&envelope, PI, 6.0);
    let shin = group(&envelope, 0.0, 5.0);
    let tibia = Loft {
        z: [6.0, LENGTH_MM - 6.0],
        ends: [End::Fillet(4.0); 2],
        centre: Box::new(tibia_centre),
        radius: Box::new(tibia_radius),
    };
    let fibula = Loft {
        z: [8.0, LENGTH_MM - 16.0],
        ends: [End::Dome(6.0); 2],
        centre: Box::new(fibula_centre),
        radius: Box::new(|z, _| 6.0 + 2.0 * smooth_step(0.85, 1.0, t(z))),
    };
    Body {
        spacing_m: 4e-3,
        pinned: &["tibia", "fibula"],
        parts: vec![
            part("subcutaneous", "fat", &envelope),
            part("calf", "muscle", &calf),
            part("shin", "muscle", &shin),
            part("tibia", "bone", &tibia),
            part("fibula", "bone", &fibula),
        ],
    }
}

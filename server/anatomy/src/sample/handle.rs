//! The handle of a product: a soft grip with four finger grooves around a hard core.
//!
//! The fingers close around it from +X; Z runs along it.

use super::loft::{End, Loft, bell};
use super::{Body, Part};

const LENGTH_MM: f64 = 120.0;
/// Triangles of about this size: the spacing of the default scene.
const STEP_MM: f64 = 2.0;
/// A finger's breadth.
const FINGER_MM: f64 = 22.0;
/// Depth of a groove: the grip stays at least 3 mm thick over the core.
const GROOVE_MM: f64 = 2.5;
const FINGERS: u32 = 4;

fn grip_radius(z: f64, theta: f64) -> f64 {
    let belly = 16.0 + 1.5 * bell(z, 0.45 * LENGTH_MM, 40.0);
    let oval = 1.0 + 0.08 * (2.0 * theta).cos();
    let first = 0.5 * (LENGTH_MM - f64::from(FINGERS - 1) * FINGER_MM);
    let fingers: f64 = (0..FINGERS)
        .map(|k| bell(z, first + f64::from(k) * FINGER_MM, 0.3 * FINGER_MM))
        .sum();
    let inside_of_the_hand = (2.0 * (theta.cos() - 1.0)).exp();
    belly * oval - GROOVE_MM * fingers * inside_of_the_hand
}

/// The sample with all its regions.
pub(super) fn body() -> Body {
    let grip = Loft {
        z: [0.0, LENGTH_MM],
        ends: [End::Fillet(7.0); 2],
        centre: Box::new(|_| [0.0, 0.0]),
        radius: Box::new(grip_radius),
    };
    let core = Loft {
        z: [6.0, LENGTH_MM - 6.0],
        ends: [End::Fillet(3.0); 2],
        centre: Box::new(|_| [0.0, 0.0]),
        radius: Box::new(|_, _| 9.0),
    };
    let part = |name, material, loft: &Loft| Part {
        name,
        material,
        surface: loft.surface(STEP_MM),
    };
    Body {
        spacing_m: 2e-3,
        pinned: &["core"],
        parts: vec![part("grip", "foam", &grip), part("core", "abs", &core)],
    }
}

//! A block cut from the anterior abdominal wall above the umbilicus (Lin 2007, fig. 3.1).
//!
//! X points to the left side of the body, Y to the front, Z up. From the front: skin, fat, the rectus sheath
//! (fascia) with the two rectus muscles in it and the linea alba between them, peritoneum. The block has a flat
//! back and curves like the belly in front. The tissue behind the peritoneum holds the block, so the peritoneum
//! is pinned.
//!
//! Layers are at least as thick as the spacing of 3 mm: skin, sheath and peritoneum are thicker than in life
//! (2, 1 and below 1 mm). All layers except the muscles reach from the back of the block to their own front and
//! share its back and sides. A later layer overrides an earlier one, so the visible rest of each is its layer.

use super::loft::{End, Loft};
use super::slab::Slab;
use super::{Body, Part};

const HALF_WIDTH_MM: f64 = 72.0;
const LENGTH_MM: f64 = 110.0;
/// Triangles of about this size: the spacing of the default scene.
const STEP_MM: f64 = 3.0;

const PERITONEUM_MM: f64 = 4.0;
/// Sheath behind and before the muscle.
const SHEATH_MM: f64 = 4.0;
/// Thickness of a rectus muscle at its middle.
const RECTUS_MM: f64 = 12.0;
const RECTUS_HALF_WIDTH_MM: f64 = 27.0;
/// Half the width of the linea alba.
const LINEA_ALBA_MM: f64 = 5.0;
/// Fat at the sides of the block.
const FAT_MM: f64 = 13.0;
/// Additional fat in the middle.
const CURVE_MM: f64 = 5.0;
const SKIN_MM: f64 = 4.0;

/// Thickness up to the front of the sheath, thinner at the linea alba.
fn sheath(x: f64) -> f64 {
    let full = PERITONEUM_MM + 2.0 * SHEATH_MM + RECTUS_MM;
    full - 5.0 * (-(x / (1.2 * LINEA_ALBA_MM)).powi(2)).exp()
}

/// Thickness up to the front of the fat: the belly's curve, fuller towards the umbilicus below.
fn fat(x: f64, z: f64) -> f64 {
    let full = PERITONEUM_MM + 2.0 * SHEATH_MM + RECTUS_MM + FAT_MM;
    let belly = CURVE_MM * (1.0 - (x / HALF_WIDTH_MM).powi(2));
    full + belly + 2.0 * (1.0 - z / LENGTH_MM) - 2.0 * (-(x / 12.0).powi(2)).exp()
}

/// One of the two muscles: an oval, cut with the block.
fn rectus(side: f64) -> Loft<'static> {
    let middle = side * (LINEA_ALBA_MM + RECTUS_HALF_WIDTH_MM);
    let height = PERITONEUM_MM + SHEATH_MM + 0.5 * RECTUS_MM;
    Loft {
        z: [0.0, LENGTH_MM],
        ends: [End::Flat; 2],
        centre: Box::new(move |_| [middle, height]),
        radius: Box::new(|_, theta| {
            // A fourth-power oval: flatter before and behind than an ellipse.
            let [a, b] = [RECTUS_HALF_WIDTH_MM, 0.5 * RECTUS_MM];
            ((theta.cos() / a).powi(4) + (theta.sin() / b).powi(4)).powf(-0.25)
        }),
    }
}

/// The sample with all its regions.
pub(super) fn body() -> Body {
    let layer = |name, material, thickness: &dyn Fn(f64, f64) -> f64| {
        let slab = Slab {
            half_width: HALF_WIDTH_MM,
            length: LENGTH_MM,
            bottom: &|_, _| 0.0,
            top: thickness,
        };
        Part {
            name,
            material,
            surface: slab.surface(STEP_MM),
        }
    };
    let muscle = |name, side| Part {
        name,
        material: "muscle",
        surface: rectus(side).surface(STEP_MM),
    };
    Body {
        spacing_m: 3e-3,
        pinned: &["peritoneum"],
        parts: vec![
            layer("skin", "skin", &|x, z| fat(x, z) + SKIN_MM),
            layer("fat", "fat", &fat),
            layer("sheath", "fascia", &|x, _| sheath(x)),
            muscle("rectus_right", -1.0),
            muscle("rectus_left", 1.0),
            layer("peritoneum", "fascia", &|_, _| PERITONEUM_MM),
        ],
    }
}

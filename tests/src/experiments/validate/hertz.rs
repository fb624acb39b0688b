//! A ball on a half space (Hertz 1882).
//!
//! The block is a piece of the half space. Its bottom and sides have the displacements of the Hertz solution, which do
//! not depend on Young's modulus, because a free or rigid boundary at ten contact radii would still change the force by
//! 8 %.

use std::f64::consts::{PI, TAU};

use palpate_tissue::{Tool, Vec3, block};

use super::comparison::{Case, Curve, CurveSet};
use super::specimen::{Specimen, YOUNG_PA, material};

/// Contact radius, and that of the ball in contact radii: the strain is below 1 %.
const CONTACT_M: f64 = 12e-3;
const BALL: f64 = 100.0;
/// Half width and depth of the block in contact radii.
const REACH: f64 = 3.0;
/// Depths of the curve, as shares of the contact radius.
const SHARES: [f64; 4] = [0.4, 0.6, 0.8, 1.0];
/// Rings of equal force on the contact area, and points on each.
const RINGS: usize = 8;
const ANGLES: usize = 12;

fn ball_m() -> f64 {
    BALL * CONTACT_M
}

fn force_n(contact_m: f64, poisson: f64) -> f64 {
    4.0 / 3.0 * YOUNG_PA / (1.0 - poisson * poisson) * contact_m.powi(3) / ball_m()
}

/// Displacement by a force of 1 N into the half space below the origin, times the shear modulus (Boussinesq 1885).
/// The z axis leads out of the half space.
fn boussinesq(at: Vec3, poisson: f64) -> Vec3 {
    let (rho, depth) = (at.norm(), -at.z);
    let across = depth / rho.powi(3) - (1.0 - 2.0 * poisson) / (rho * (rho + depth));
    let down = depth * depth / rho.powi(3) + 2.0 * (1.0 - poisson) / rho;
    Vec3::new(at.x * across, at.y * across, -down) / (4.0 * PI)
}

/// Displacement in m far below or beside the contact area, whose middle is the origin.
fn displacement(at: Vec3, contact_m: f64, poisson: f64) -> Vec3 {
    let mut sum = Vec3::zeros();
    for ring in 0..RINGS {
        let share = (ring as f64 + 0.5) / RINGS as f64;
        let radius = contact_m * (1.0 - (1.0 - share).powf(2.0 / 3.0)).sqrt();
        for i in 0..ANGLES {
            let angle = TAU * (i as f64 + 0.5) / ANGLES as f64;
            let from = Vec3::new(angle.cos(), angle.sin(), 0.0) * radius;
            sum += boussinesq(at - from, poisson);
        }
    }
    let shear_pa = YOUNG_PA / (2.0 * (1.0 + poisson));
    sum * (force_n(contact_m, poisson) / shear_pa / (RINGS * ANGLES) as f64)
}

pub(super) fn ball(poisson: f64, curve: &mut Curve) -> Result<Case, String> {
    let mut case = Case {
        name: "Hertz contact",
        poisson,
        quantity: "force on the ball (N)",
        reference: "Hertz 1882",
        expected: force_n(CONTACT_M, poisson),
        length: ("contact radius", CONTACT_M),
        runs: Vec::new(),
    };
    // Cells over the half width of the block.
    let widths = [8, 12, 18];
    for half in widths {
        let spacing_m = REACH * CONTACT_M / half as f64;
        let model = block([2 * half, 2 * half, half], spacing_m, &material(poisson), 0);
        let mut specimen = Specimen::new(model);
        let wide = REACH * CONTACT_M;
        let top = Vec3::new(wide, wide, wide);
        let is_cut = |at: Vec3| {
            let side = |x: f64| x < 1e-6 * wide || x > 2.0 * wide - 1e-6 * wide;
            side(at.x) || side(at.y) || at.z < 1e-6 * wide
        };
        let mut points = Vec::new();
        for share in SHARES {
            let is_last = share == 1.0;
            if !is_last && half != widths[widths.len() - 1] {
                continue;
            }
            let contact_m = share * CONTACT_M;
            specimen
                .hold(|_, at| is_cut(at).then(|| displacement(at - top, contact_m, poisson)))?;
            let depth = contact_m * contact_m / ball_m();
            let centre = top + Vec3::z() * (ball_m() - depth);
            specimen.solve(&[Tool::ball(1, centre, ball_m())]);
            let force = specimen.tissue.report().reactions[0].force.z;
            points.push((1e3 * depth, force));
            if is_last {
                case.add(&specimen, force);
            }
        }
        if half == widths[widths.len() - 1] {
            let closed = (0..=50).map(|i| {
                let contact_m = (f64::from(i) / 50.0).sqrt() * CONTACT_M;
                (
                    1e3 * contact_m * contact_m / ball_m(),
                    force_n(contact_m, poisson),
                )
            });
            curve.sets.push(CurveSet {
                poisson,
                measured: points,
                reference: closed.collect(),
            });
        }
    }
    Ok(case)
}

pub(super) fn curve() -> Curve {
    Curve {
        name: "validate-hertz",
        title: "Force of a ball pressed on a half space",
        axes: ["depth (mm)", "force (N)"],
        sets: Vec::new(),
    }
}

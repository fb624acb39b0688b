//! Reaction on a tool and its stiffness.

use nalgebra::{Matrix3, UnitQuaternion};

use super::PLACES_MAX;
use super::contact_sample::depth;
use super::contacts::Contacts;
use super::core::patch_index;
use crate::{Topology, Vec3};

/// Ratio of the net force of a patch to its total pressure below which the net direction is not a surface normal.
const ONE_SIDED: f64 = 0.3;

/// Reaction of the tissue on one tool.
#[derive(Debug, Clone, PartialEq)]
pub struct Reaction {
    /// Identifier of the tool.
    pub tool: u32,
    /// Force on the tool in N.
    pub force: Vec3,
    /// Torque on the tool about its pivot in N m.
    pub torque: Vec3,
    /// Estimate of -dF/dx in N/m, symmetric and positive semidefinite, for a tool without rotation.
    pub stiffness: Matrix3<f64>,
    /// Unit vector out of the tissue, along the force; zero without contact.
    pub normal: Vec3,
    /// Surface samples that carry the force.
    pub contacts: u32,
    /// Coefficient of static friction of the touched material.
    pub friction_static: f64,
    /// Coefficient of dynamic friction of the touched material.
    pub friction_dynamic: f64,
    /// Estimate of the error of `force` in N: its change in the last iteration.
    pub force_error: f64,
    /// Position where the force holds: the proxy's pivot, which equals the tool's unless the tissue has yet to yield.
    pub at: Vec3,
    /// Distance from the proxy to the tool in m.
    pub lag_m: f64,
    /// Rotation of the proxy.
    pub turn: UnitQuaternion<f64>,
    /// Contact patches in the order of their numbers. Their forces sum to `force`.
    pub contact_patches: Vec<ContactPatch>,
    /// The hold of the tissue on an inserted needle, in place of contact patches.
    pub shaft: Option<ShaftReaction>,
    /// Whether the tissue holds the needle after the step, by the decision of this shape.
    pub is_inserted: bool,
}

/// Forces of the tissue on an inserted needle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShaftReaction {
    /// From the pivot to the tip, in m.
    pub tip: Vec3,
    /// Unit vector from the tip up the shaft.
    pub axis: Vec3,
    /// Force on the needle along the axis, in N.
    pub axial_n: f64,
    /// Greatest friction along the shaft, in N: a needle that is withdrawn feels no more.
    pub friction_n: f64,
    /// Forces on the needle across the axis, in N, at the tip and where it enters, and their levers from the pivot, in m.
    pub stations: [(Vec3, Vec3); 2],
}

/// One contact patch of a tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactPatch {
    /// Number of the patch, below [`PLACES_MAX`]: stable from step to step.
    pub number: u8,
    /// From the pivot to the centre of pressure, in m: the mean of the samples weighted by force.
    pub lever: Vec3,
    /// Force on the tool in this patch, in N.
    pub force: Vec3,
    /// Unit vector out of the tissue; out of one of the sides if two sides press equally.
    pub normal: Vec3,
    /// Total pressure from all sides in N, at least the norm of `force`. Friction is proportional to it: a needle in
    /// its channel is held although its net force is zero.
    pub pressed: f64,
    /// Displacement of the tissue by the tool along the force, in m: the mean of the samples weighted by force,
    /// relative to the equilibrium without tools. Always positive.
    pub indentation_m: f64,
    /// Coefficient of static friction in this patch.
    pub friction_static: f64,
    /// Coefficient of dynamic friction in this patch.
    pub friction_dynamic: f64,
}

/// One pressed sample in the frame of its tool.
struct PressedSample {
    place: usize,
    /// From the pivot, in m.
    lever: Vec3,
    force: Vec3,
    amount: f64,
    /// In m.
    indentation: f64,
    /// μ, static and dynamic.
    friction: [f64; 2],
}

impl ContactPatch {
    /// Sums the samples of one patch, of which there is at least one.
    fn of(number: usize, samples: &[&PressedSample]) -> Self {
        let force: Vec3 = samples.iter().map(|f| f.force).sum();
        let sum: f64 = samples.iter().map(|f| f.amount).sum();
        let mean =
            |of: &dyn Fn(&PressedSample) -> f64| samples.iter().map(|f| of(f)).sum::<f64>() / sum;
        let lever: Vec3 = samples.iter().map(|f| f.lever * f.amount).sum();
        let normal = force
            .try_normalize(ONE_SIDED * sum)
            .unwrap_or_else(|| main_axis(samples));
        let side = |which: f64| -> Vec3 {
            let on = samples
                .iter()
                .filter(|f| which * f.force.dot(&normal) > 0.0);
            on.map(|f| f.force).sum()
        };
        Self {
            number: number as u8,
            lever: lever / sum,
            force,
            normal,
            pressed: (side(1.0).norm() + side(-1.0).norm()).max(force.norm()),
            indentation_m: mean(&|f| f.amount * f.indentation),
            friction_static: mean(&|f| f.amount * f.friction[0]),
            friction_dynamic: mean(&|f| f.amount * f.friction[1]),
        }
    }
}

/// The direction that most of the pressure is along.
fn main_axis(samples: &[&PressedSample]) -> Vec3 {
    let mut sum = Matrix3::zeros();
    for f in samples.iter().filter(|f| f.amount > 0.0) {
        sum += f.force * f.force.transpose() / f.amount;
    }
    let eigen = sum.symmetric_eigen();
    eigen.eigenvectors.column(eigen.eigenvalues.imax()).into()
}

impl Contacts {
    /// The reaction on the tool of proxy `i`; also updates its depth. `untouched` is the displacement of every node in
    /// the equilibrium without tools; `None` if that is zero.
    pub(crate) fn reaction(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        untouched: Option<&[Vec3]>,
        i: usize,
    ) -> Reaction {
        if let Some(reaction) = self.shaft_reaction(topology, u, i) {
            return reaction;
        }
        let (samples, nearest) = self.pressed_samples(topology, u, untouched, i);
        let spacing = topology.model().spacing_m;
        let proxy = &mut self.proxies[i];
        proxy.set_depth(nearest, spacing);
        if samples.is_empty() {
            proxy.secant.clear();
            proxy.multipliers.clear();
        }
        let force: Vec3 = samples.iter().map(|f| f.force).sum();
        let torque = samples.iter().map(|f| f.lever.cross(&f.force)).sum();
        let sum: f64 = samples.iter().map(|f| f.amount).sum();
        let share = if sum > 0.0 { 1.0 / sum } else { 0.0 };
        let deepest = samples.iter().map(|f| f.indentation).fold(0.0, f64::max);
        proxy.note_indentation(&force, deepest);
        let friction = |k: usize| {
            samples
                .iter()
                .map(|f| f.amount * f.friction[k])
                .sum::<f64>()
        };
        let mut of_place: [Vec<&PressedSample>; PLACES_MAX] = Default::default();
        for f in &samples {
            of_place[f.place].push(f);
        }
        let touched = of_place.iter().enumerate().filter(|(_, f)| !f.is_empty());
        Reaction {
            tool: proxy.id,
            force,
            torque,
            stiffness: proxy.secant.stiffness(),
            normal: force.try_normalize(1e-12).unwrap_or_else(Vec3::zeros),
            contacts: samples.len() as u32,
            friction_static: friction(0) * share,
            friction_dynamic: friction(1) * share,
            force_error: 0.0,
            at: proxy.at,
            lag_m: proxy.lag(),
            turn: proxy.turn,
            contact_patches: touched.map(|(n, f)| ContactPatch::of(n, f)).collect(),
            shaft: None,
            is_inserted: false,
        }
    }

    /// The pressed samples of proxy `i`, and the depth in m of the deepest sample, negative where none is pressed.
    fn pressed_samples(
        &self,
        topology: &Topology,
        u: &[Vec3],
        untouched: Option<&[Vec3]>,
        i: usize,
    ) -> (Vec<PressedSample>, Option<f64>) {
        let proxy = &self.proxies[i];
        let parts = proxy
            .core
            .contact_patches(proxy.radius, topology.model().spacing_m);
        let (mut samples, mut nearest) = (Vec::new(), None::<f64>);
        for sample in self.samples.iter().filter(|s| s.proxy == i as u32) {
            let on_core = proxy.core.nearest(&sample.position(u));
            let c = proxy.core.at(on_core);
            let (depth, n) = depth(sample.position(u) - c, proxy.radius);
            nearest = Some(nearest.map_or(depth, |d| d.max(depth)));
            let pressed = sample.multiplier + depth;
            let amount = sample.stiffness * pressed;
            if amount > 0.0 {
                let face = topology.exposed.faces[sample.triangle as usize / 2];
                let material = topology.model().material_of(face.cell() as usize);
                samples.push(PressedSample {
                    place: patch_index(on_core, parts),
                    // On the surface of the real tool, without the inset.
                    lever: c + n * (proxy.radius - proxy.inset) - proxy.at,
                    force: -n * amount,
                    amount,
                    // A sample that opens still has a force.
                    indentation: (depth + sample.moved(u, untouched).dot(&n)).max(pressed),
                    friction: [material.friction_static, material.friction_dynamic],
                });
            }
        }
        (samples, nearest)
    }

    /// Updates the stiffness estimate in N/m of the tool of proxy `i` from its reaction, at first touch to force over
    /// indentation. `own` is the stiffness of a node under it, for the first estimate of an inserted needle.
    pub(crate) fn learn(
        &mut self,
        u: &[Vec3],
        i: usize,
        reaction: &Reaction,
        own: f64,
        spacing: f64,
    ) -> Matrix3<f64> {
        let middle = self.middle(u, i);
        let proxy = &mut self.proxies[i];
        if !proxy.secant.is_known() {
            let first = if reaction.contact_patches.is_empty() {
                let wide = (proxy.radius / spacing).max(0.5) * proxy.core.spans(spacing).sqrt();
                0.5 * own * wide
            } else {
                let along = |p: &ContactPatch| p.force.dot(&reaction.normal) / p.indentation_m;
                reaction
                    .contact_patches
                    .iter()
                    .map(along)
                    .sum::<f64>()
                    .max(0.0)
            };
            proxy.secant.start(&reaction.normal, first, 0.3);
        }
        proxy.secant.learn(middle, reaction.force, 0.01 * spacing);
        proxy.secant.stiffness()
    }

    /// The centre of pressure of proxy `i`, on its core: it moves with the tool.
    fn middle(&self, u: &[Vec3], i: usize) -> Vec3 {
        let proxy = &self.proxies[i];
        if proxy.target.is_ball() {
            return proxy.at;
        }
        let (mut at, mut sum) = (Vec3::zeros(), 0.0);
        for sample in self.samples.iter().filter(|s| s.proxy == i as u32) {
            let (pressed, _) = self.force_over_stiffness(sample, u);
            if pressed > 0.0 {
                let on_core = proxy.core.nearest(&sample.position(u));
                at += proxy.core.at(on_core) * (sample.stiffness * pressed);
                sum += sample.stiffness * pressed;
            }
        }
        if sum > 0.0 { at / sum } else { proxy.core.mid }
    }
}

/// Minimum cosine between move and force change for an update. Below it, the change has mostly other causes (another
/// tool, settling tissue), and the update divides by the cosine.
const ALIGNED: f64 = 0.3;

/// Secant stiffness from pairs of poses and forces: the BFGS update of K so that K s = -ΔF for the latest move s, which
/// keeps K symmetric and positive.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Secant {
    last: Option<(Vec3, Vec3)>,
    stiffness: Option<Matrix3<f64>>,
}

impl Secant {
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }

    fn is_known(&self) -> bool {
        self.stiffness.is_some()
    }

    /// Starts from a measured normal stiffness; `across` is the tangential fraction.
    fn start(&mut self, normal: &Vec3, stiffness: f64, across: f64) {
        let along = normal * normal.transpose();
        self.stiffness =
            Some(along * stiffness + (Matrix3::identity() - along) * (stiffness * across));
    }

    /// Updates by the force at a pose; moves below `least` metres are noise.
    fn learn(&mut self, at: Vec3, force: Vec3, least: f64) {
        let Some((x, f)) = self.last else {
            self.last = Some((at, force));
            return;
        };
        let (s, y) = (at - x, f - force);
        if s.norm() < least {
            return;
        }
        self.last = Some((at, force));
        let Some(k) = self.stiffness else {
            return;
        };
        let ks = k * s;
        let (curve, power) = (s.dot(&ks), s.dot(&y));
        if power > ALIGNED * y.norm() * s.norm() && curve > 0.0 {
            let next = k + y * y.transpose() / power - ks * ks.transpose() / curve;
            if next.iter().all(|v| v.is_finite()) {
                self.stiffness = Some((next + next.transpose()) * 0.5);
            }
        }
    }

    pub(super) fn stiffness(&self) -> Matrix3<f64> {
        self.stiffness.unwrap_or_else(Matrix3::zeros)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secant_stiffness_finds_a_linear_law_and_stays_symmetric() {
        let law = Matrix3::new(3.0, 0.5, 0.0, 0.5, 2.0, -0.3, 0.0, -0.3, 4.0) * 100.0;
        let mut secant = Secant::default();
        secant.start(&Vec3::z(), 50.0, 0.2);
        for i in 0..60 {
            let t = f64::from(i);
            let x = Vec3::new((1.3 * t).sin(), (2.1 * t).cos(), (0.7 * t).sin()) * 1e-3;
            secant.learn(x, -law * x, 1e-5);
        }
        let k = secant.stiffness();
        assert!((k - law).norm() < 0.1 * law.norm(), "{k}");
        assert!((k - k.transpose()).norm() < 1e-9);
    }

    #[test]
    fn force_change_across_a_move_does_not_update_the_stiffness() {
        let mut secant = Secant::default();
        secant.start(&Vec3::z(), 50.0, 0.3);
        secant.learn(Vec3::zeros(), Vec3::zeros(), 1e-5);
        // Another tool presses nearby while this one moves 0.1 mm along the surface.
        let x = Vec3::new(1e-4, 0.0, 0.0);
        secant.learn(x, Vec3::new(-1e-3, 0.0, 2e-2), 1e-5);
        assert_eq!(secant.stiffness()[(2, 2)], 50.0);
        // The next aligned move updates the estimate.
        secant.learn(x - Vec3::z() * 1e-4, Vec3::new(-1e-3, 0.0, 2.8e-2), 1e-5);
        assert!((secant.stiffness()[(2, 2)] - 80.0).abs() < 1e-9);
    }
}

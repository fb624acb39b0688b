//! The proxy of a tool: its position outside the tissue.

use nalgebra::UnitQuaternion;

use super::ball::Ball;
use super::constraint::{Constraint, Motion, dot, length, nearest_motion};
use super::core::Core;
use super::insertion::Insertion;
use super::multipliers::Multipliers;
use super::reaction::Secant;
use super::surface::{Foot, Surface, area_normal, blend};
use super::{PITCH, POINT_RADIUS, Tool};
use crate::Vec3;

/// Maximum steps of the search for the first touch on a free path; a longer path counts as a jump.
const MARCH_MAX: usize = 64;
/// Maximum searches of all steps together, one per step and sampling point of the tool. A plate of 256 points then takes two
/// steps, 0.5 m/s at 250 solves per second. Without this bound a large plate that hovers over the tissue costs every
/// site 0.1 s per solve.
const SEARCHES_MAX: usize = 512;
/// Maximum travel per iteration in contact, in radii (of at least half a spacing).
const TRAVEL: f64 = 0.5;

/// Distance in m between proxy and tool that no device holds: 10 N at 0.5 N/mm.
const JUMP_M: f64 = 20e-3;

/// Search distance around a tool's surface in spacings.
pub(crate) const REACH: f64 = 2.0;
/// Distance to the tissue, in radii (of at least half a spacing), at which contact is lost.
const LOST: f64 = 0.5;
/// Depth of a sample, in radii, at which the proxy waits for the tissue to yield. 0.1 is the depth of a flat triangle under a
/// ball of 0.75 spacings, where up to two thirds of the force were missing; with 0.25 a ball of 3 mm that is pressed 30 mm into
/// a thigh has no force in 98 instead of 33 of 3,000 steps, with samples half instead of 0.7 radii apart.
const DEPTH_MAX: f64 = 0.15;
/// Share of that depth by which a motion may exceed it; a later one returns by as much.
const SLACK: f64 = 0.01;
/// Motion in radii below which a proxy waits.
const MOVED_MIN: f64 = 2e-3;
/// Maximum way in strides whose nearest motion is sought: in a narrow groove, the search over a long way would not end.
const WAY_MAX: f64 = 4.0;
/// Motion, relative to the maximum travel, below which a proxy is blocked.
const BLOCKED: f64 = 0.5;
/// Distance from the surface, in radii, below which a placed tool starts outside even if its middle is outside: tissue in the
/// plane of the middle does not face it and gives no contact. (With the middle 0.0125 radii above the surface a quick step
/// found half of the force, 0.125 radii above it 98 %.)
const BESIDE: f64 = 0.1;

/// How a tool starts its next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Placement {
    /// It appears at its pose.
    New,
    /// It continues.
    Placed,
    /// It lost its contact, maybe because the surface passed through it.
    Lost,
}

/// State of a tool between steps.
#[derive(Clone)]
pub(crate) struct Proxy {
    pub(crate) id: u32,
    /// Contact radius in m; see `inset`.
    pub(crate) radius: f64,
    /// Excess of the contact radius over the tool's; the surface is offset inwards by it.
    pub(crate) inset: f64,
    pub(crate) target: Tool,
    /// Way out of the tissue along the contact force, in m: the indentation at full strength.
    out: Vec3,
    /// Position of the pivot, and rotation.
    pub(crate) at: Vec3,
    pub(crate) turn: UnitQuaternion<f64>,
    /// Core in the current pose.
    pub(crate) core: Core,
    /// Allowed gap in m to the tissue it touched: the retreat of the tool, plus the displacement still to follow.
    pub(crate) gap: f64,
    pub(crate) touching: bool,
    /// Bounds of its motion by the samples of the last evaluation.
    constraints: Vec<Constraint>,
    /// Length in m of its last motion.
    moved: f64,
    /// Pose at the start of the step, and whether it was in contact.
    start: (Vec3, UnitQuaternion<f64>),
    was_in_contact: bool,
    /// Motion of the last step, if that began in contact.
    last_motion: Option<Motion>,
    pub(crate) placement: Placement,
    pub(crate) seen: bool,
    pub(super) multipliers: Multipliers,
    pub(super) secant: Secant,
    pub(crate) insertion: Insertion,
}

impl Proxy {
    pub(crate) fn new(tool: &Tool) -> Self {
        let core = Core::of(tool);
        Self {
            id: tool.id,
            radius: tool.radius_m,
            inset: 0.0,
            target: *tool,
            out: Vec3::zeros(),
            at: tool.centre,
            turn: tool.turn,
            core,
            gap: 0.0,
            touching: false,
            constraints: Vec::new(),
            moved: 0.0,
            start: (tool.centre, tool.turn),
            was_in_contact: false,
            last_motion: None,
            placement: Placement::New,
            seen: true,
            multipliers: Multipliers::default(),
            secant: Secant::default(),
            insertion: Insertion::Unknown,
        }
    }

    /// Sets the target pose. Returns whether it changed.
    pub(crate) fn follow(&mut self, tool: &Tool) -> bool {
        let tool = &Tool {
            centre: tool.centre + self.withdrawal(tool.strength),
            ..*tool
        };
        let changed = self.target != *tool;
        let other = self.target.form != tool.form;
        let is_other_needle = other || self.target.needle.is_some() != tool.needle.is_some();
        self.target = *tool;
        if is_other_needle {
            self.insertion = Insertion::Unknown;
        }
        if other {
            // A closing jaw meets the tissue between its parts from outside.
            self.set(self.at, self.turn);
            self.placement = Placement::New;
        }
        if tool.is_ball() {
            // A ball turns without moving its surface.
            self.turn = tool.turn;
        }
        self.start_step();
        changed
    }

    /// Notes the motion of the last step.
    fn start_step(&mut self) {
        let here = (self.at, self.turn);
        let motion = self.motion_between(self.start, here);
        self.last_motion = self.was_in_contact.then_some(motion);
        self.start = here;
        self.was_in_contact = self.is_in_contact();
    }

    /// Its motion in this step along that of the last one, relative to it: one in steady motion and at first touch, zero if
    /// it stops or turns back. Motions far below those of a proxy that waits count as none.
    pub(super) fn pace(&self) -> f64 {
        let Some(last) = self.last_motion else {
            return 1.0;
        };
        let motion = self.motion_between(self.start, (self.at, self.turn));
        let least = MOVED_MIN * self.radius;
        (dot(&motion, &last) / dot(&last, &last).max(least * least)).clamp(0.0, 1.0)
    }

    /// Whether the tissue presses on it or holds it.
    pub(super) fn is_in_contact(&self) -> bool {
        self.touching || self.insertion.is_in()
    }

    /// Displacement of the tool at a strength. The hold of the tissue on a needle is no indentation.
    fn withdrawal(&self, strength: f64) -> Vec3 {
        if self.insertion.is_in() {
            return Vec3::zeros();
        }
        self.out * (1.0 - strength)
    }

    /// Notes the indentation of a tool at full strength.
    pub(super) fn note_indentation(&mut self, force: &Vec3, indentation_m: f64) {
        if self.target.strength == 1.0 {
            let out = force.try_normalize(1e-12).unwrap_or_else(Vec3::zeros);
            self.out = out * indentation_m;
        }
    }

    /// Adapts the proxy to the lattice: a tool thinner than the resolution presses as a wider one on a surface that is
    /// offset inwards.
    pub(crate) fn fit(&mut self, spacing: f64) {
        self.radius = self.target.radius_m.max(POINT_RADIUS * spacing);
        self.inset = self.radius - self.target.radius_m;
    }

    /// Sampling points of a thin tool.
    fn points(&self, spacing: f64) -> Vec<[f64; 2]> {
        self.core.points(PITCH * spacing)
    }

    /// Search regions of this step.
    pub(crate) fn balls(&self, spacing: f64) -> Vec<Ball> {
        let mut reach = self.radius + self.inset + self.gap + REACH * spacing;
        // The path of a jump is not searched.
        if self.lag() <= 2.0 * reach {
            reach += self.lag();
        }
        Core::of(&self.target).cover(reach)
    }

    /// Distance in m between proxy and tool, at the farthest end.
    pub(crate) fn lag(&self) -> f64 {
        let way = (self.target.centre - self.at).norm();
        if self.target.is_ball() {
            return way;
        }
        way + self.arm() * self.turn.angle_to(&self.target.turn)
    }

    /// Whether its next motion may differ from the last one: it still follows its tool, or has yet to be placed again.
    pub(super) fn is_following(&self) -> bool {
        let moves = self.constraints.is_empty() || self.moved > MOVED_MIN * self.radius;
        self.placement == Placement::Lost || self.lag() > 0.0 && moves
    }

    /// Distance in m from the pivot to the farthest point of its core.
    fn arm(&self) -> f64 {
        self.target.form.mid.norm() + self.core.half_diagonal()
    }

    /// Sets the pose.
    fn set(&mut self, at: Vec3, turn: UnitQuaternion<f64>) {
        (self.at, self.turn) = (at, turn);
        self.core = Core::of(&Tool {
            centre: at,
            turn,
            ..self.target
        });
    }

    /// Moves a fraction of the way from the previous pose to the tool.
    fn approach(&mut self, [at, turn]: [(Vec3, UnitQuaternion<f64>); 2], share: f64) {
        let way = turn.0 - at.0;
        if self.target.is_ball() {
            // The rotation of a ball is irrelevant.
            return self.set(at.0 + way * share, turn.1);
        }
        let turned = at.1.try_slerp(&turn.1, share, 1e-9).unwrap_or(turn.1);
        self.set(at.0 + way * share, turned);
    }

    /// Moves towards the tool; stops at the first touch.
    pub(crate) fn advance(&mut self, surface: &Surface<'_>) {
        let (at, turn) = (self.at, self.turn);
        let touched = self.touching;
        self.go(surface);
        self.moved = (self.at - at).norm();
        if !self.target.is_ball() {
            self.moved += self.arm() * self.turn.angle_to(&turn);
        }
        // The hold of the tissue needs no samples of the surface.
        if touched && !self.insertion.is_in() {
            self.gap += self.moved;
        }
    }

    /// Updates the penetration depth in m (negative: the gap to the tissue); `None` if no tissue is near.
    pub(crate) fn set_depth(&mut self, depth: Option<f64>, spacing: f64) {
        self.gap = depth.map_or(0.0, |d| (-d).max(0.0));
        // Tissue that still follows a retreating tool would otherwise pass through it.
        let lost = LOST * self.radius.max(0.5 * spacing);
        let keeps = depth.is_some() && self.gap < lost;
        if self.touching && !keeps {
            self.placement = Placement::Lost;
        }
        self.touching &= keeps;
    }

    pub(super) fn go(&mut self, surface: &Surface<'_>) {
        let spacing = surface.topology.model().spacing_m;
        let stride = TRAVEL * self.radius.max(0.5 * spacing);
        match std::mem::replace(&mut self.placement, Placement::Placed) {
            Placement::New => self.appear(surface, f64::MAX),
            Placement::Lost if !self.insertion.is_in() => {
                self.place(surface, self.radius + REACH * spacing);
            }
            Placement::Lost | Placement::Placed => {}
        }
        let length = self.lag();
        let there = (self.target.centre, self.target.turn);
        if length == 0.0 {
            // Tissue may have followed the tool after contact was lost.
            self.touching = self.touching || self.touches(surface, spacing);
            return;
        }
        let from = (self.at, self.turn);
        if self.touching {
            if !self.insertion.is_in() {
                self.push_on(stride, surface);
            } else if length <= stride {
                self.set(there.0, there.1);
            } else {
                self.approach([from, there], stride / length);
            }
            return;
        }
        let steps = (length / stride).ceil() as usize;
        let searches = self.points(spacing).len();
        if steps > MARCH_MAX.min(SEARCHES_MAX / searches) {
            self.set(there.0, there.1);
            // Every point was outside, so the surface is no farther than its path.
            self.appear(surface, length + self.radius + spacing);
            return;
        }
        for s in 1..=steps {
            if s == steps {
                self.set(there.0, there.1);
            } else {
                self.approach([from, there], s as f64 / steps as f64);
            }
            if self.touches(surface, spacing) {
                self.touching = true;
                break;
            }
        }
    }

    /// Moves at most by `stride` towards the tool, as far as the tissue has yielded, and along it. A tool that jumped past
    /// tissue that does not yield, such as bone, continues at its pose.
    fn push_on(&mut self, stride: f64, surface: &Surface<'_>) {
        let bound = DEPTH_MAX * self.radius;
        let stride = if self.constraints.is_empty() {
            bound
        } else {
            // Surface beyond the samples bounds no motion.
            stride.min(0.5 * surface.topology.model().spacing_m + bound)
        };
        let way = self.way();
        let share = (WAY_MAX * stride / length(&way)).min(1.0);
        let way = way.map(|part| part * share);
        let is_near = |c: &&Constraint| c.room < stride * length(&c.gradient);
        let near: Vec<Constraint> = self.constraints.iter().filter(is_near).cloned().collect();
        let motion = nearest_motion(way, &near, SLACK * bound);
        let length = length(&motion);
        if motion == way && length <= stride {
            self.set(self.target.centre, self.target.turn);
        } else {
            let share = stride / length.max(stride);
            let turn = UnitQuaternion::from_scaled_axis(motion[1] * (share / self.lever()));
            self.set(self.at + motion[0] * share, turn * self.turn);
        }
        if length < BLOCKED * stride && self.is_free_after_jump(surface) {
            self.set(self.target.centre, self.target.turn);
            self.touching = false;
        }
    }

    /// The way to the tool.
    fn way(&self) -> Motion {
        let turn = self.target.turn * self.turn.inverse();
        [
            self.target.centre - self.at,
            turn.scaled_axis() * self.lever(),
        ]
    }

    /// The motion from one pose to another. The rotation of a ball is irrelevant.
    fn motion_between(
        &self,
        from: (Vec3, UnitQuaternion<f64>),
        to: (Vec3, UnitQuaternion<f64>),
    ) -> Motion {
        let by = to.0 - from.0;
        if self.target.is_ball() {
            return [by, Vec3::zeros()];
        }
        let turn = to.1 * from.1.inverse();
        [by, turn.scaled_axis() * self.lever()]
    }

    /// Distance in m from the pivot within which its surface lies: the scale of rotations among motions.
    fn lever(&self) -> f64 {
        self.arm() + self.radius
    }

    /// Whether the tool has jumped to a pose outside the tissue where it touches nothing.
    fn is_free_after_jump(&self, surface: &Surface<'_>) -> bool {
        if self.lag() < JUMP_M {
            return false;
        }
        let spacing = surface.topology.model().spacing_m;
        let mut there = self.clone();
        there.set(self.target.centre, self.target.turn);
        let is_outside = |point| {
            let at = there.core.at(point);
            let foot = surface.nearest(at, f64::MAX);
            foot.is_none_or(|foot| (at - foot.at).dot(&foot.normal) > 0.0)
        };
        self.points(spacing).into_iter().all(is_outside) && !there.touches(surface, spacing)
    }

    pub(super) fn clear_constraints(&mut self) {
        self.constraints.clear();
    }

    /// Bounds its motion by a sample at `at`, `depth` m deep, towards `n` from its core.
    pub(super) fn add_constraint(&mut self, depth: f64, n: Vec3, at: &Vec3) {
        let bound = DEPTH_MAX * self.radius;
        self.constraints.push(Constraint {
            gradient: [n, (at - self.at).cross(&n) / self.lever()],
            room: (bound - depth).max(-SLACK * bound),
        });
    }

    /// Places a new tool. A weak tool that appears in the tissue enters it as its strength grows.
    fn appear(&mut self, surface: &Surface<'_>, reach: f64) {
        let from = self.at;
        self.place(surface, reach);
        if self.at != from {
            self.out = self.at - from;
            self.target.centre += self.withdrawal(self.target.strength);
        }
    }

    /// Leaves the tool at its pose, or moves it out of the surface if its middle is inside or [beside](BESIDE) it. The surface
    /// is searched up to `reach` m from each point.
    fn place(&mut self, surface: &Surface<'_>, reach: f64) {
        self.constraints.clear();
        self.touching = false;
        let spacing = surface.topology.model().spacing_m;
        // Moved out by its deepest penetration.
        let mut out = (0.0, Vec3::zeros());
        for point in self.points(spacing) {
            let at = self.core.at(point);
            let Some(foot) = surface.nearest(at, reach) else {
                continue;
            };
            let away = at - foot.at;
            let is_inside = away.dot(&foot.normal) < 0.0;
            let to = foot.at + foot.normal * self.target.radius_m;
            let is_beside = || {
                // In a narrow wound the opposite lip is there.
                let is_free = |foot: Foot| (to - foot.at).dot(&foot.normal) > 0.0;
                away.norm() < BESIDE * self.target.radius_m
                    && surface.nearest(to, reach).is_none_or(is_free)
            };
            if is_inside || is_beside() {
                let way = (to - at).norm();
                if way > out.0 {
                    out = (way, to + (self.at - at));
                }
                self.touching = true;
            } else if away.norm() < self.target.radius_m {
                self.touching = true;
            }
        }
        if out.0 > 0.0 {
            self.set(out.1, self.turn);
        }
    }

    fn touches(&self, surface: &Surface<'_>, spacing: f64) -> bool {
        if self.inset > 0.0 {
            let radius = self.target.radius_m;
            let reach = radius + 0.5 * spacing;
            let pressed = |at: Vec3, foot: Foot| (at - foot.at).dot(&foot.normal) < radius;
            let at_point = |at: Vec3| {
                let foot = surface.nearest(at, reach);
                foot.is_some_and(|foot| pressed(at, foot))
            };
            let mut points = self.points(spacing).into_iter();
            // Tissue may bulge between the points of a large plate.
            let found = points.any(|p| at_point(self.core.at(p)));
            if found || self.core.b == Vec3::zeros() {
                return found;
            }
        }
        let Ball { centre, radius } = self.core.ball();
        let skin = self.target.radius_m;
        surface.any_near(centre, radius + skin, |triangle| {
            let corners = surface.corners(triangle);
            let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
            let facing = self.core.towards(&middle).dot(&area_normal(&corners)) < 0.0;
            facing
                && super::contact_sample::weights_of(&corners, self.radius, spacing)
                    .iter()
                    .any(|w| {
                        let away = self.core.towards(&blend(&corners, w));
                        away.norm_squared() < skin * skin
                    })
        })
    }
}

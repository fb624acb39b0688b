//! The proxy of a tool: where it is held while tissue stands in its way.

use super::ball::Ball;
use super::reaction::Secant;
use super::surface::{Surface, area_normal};
use super::{POINT_RADIUS, Tool};
use crate::Vec3;

/// Steps in which a free path is searched for the first touch; a longer one counts as a jump.
const MARCH_MAX: usize = 64;
/// Travel per iteration while touching, in radii (of at least half a spacing).
const TRAVEL: f64 = 0.5;

/// Distance in spacings from a tool's surface at which it looks for the tissue's.
pub(crate) const REACH: f64 = 2.0;
/// Distance to the tissue, in radii (of at least half a spacing), from which on a tool has lost it.
const LOST: f64 = 0.5;
/// Depth, in such travels, at which the proxy waits for the tissue to give way.
const WAIT: f64 = 0.5;

/// What is remembered of a tool between steps.
pub(crate) struct Proxy {
    pub(crate) id: u32,
    pub(crate) radius: f64,
    pub(crate) target: Vec3,
    pub(crate) at: Vec3,
    /// Where it was before it last moved.
    pub(crate) before: Vec3,
    /// How far in m the tissue may be from it that it touched: by what it drew back, and what is still to follow.
    pub(crate) gap: f64,
    pub(crate) touching: bool,
    /// Deepest sample at the last look, in m.
    pub(crate) depth: f64,
    pub(crate) placed: bool,
    pub(crate) seen: bool,
    pub(crate) secant: Secant,
}

impl Proxy {
    pub(crate) fn new(tool: &Tool) -> Self {
        Self {
            id: tool.id,
            radius: tool.radius_m,
            target: tool.centre,
            at: tool.centre,
            before: tool.centre,
            gap: 0.0,
            touching: false,
            depth: 0.0,
            placed: false,
            seen: true,
            secant: Secant::default(),
        }
    }

    pub(crate) fn is_point(&self, spacing: f64) -> bool {
        self.radius < POINT_RADIUS * spacing
    }

    /// Where it may go and what it may feel there in this step.
    pub(crate) fn ball(&self, spacing: f64) -> Ball {
        let (centre, mut radius) = (self.target, self.radius + self.gap + REACH * spacing);
        // A tool that jumps is not followed on its way.
        if self.lag() <= 2.0 * radius {
            radius += self.lag();
        }
        Ball { centre, radius }
    }

    /// Distance in m by which the proxy is behind its tool.
    pub(crate) fn lag(&self) -> f64 {
        (self.target - self.at).norm()
    }

    /// Moves towards the tool; stops at the first touch.
    pub(crate) fn advance(&mut self, surface: &Surface<'_>) {
        self.before = self.at;
        let touched = self.touching;
        self.go(surface);
        if touched {
            self.gap += (self.at - self.before).norm();
        }
    }

    /// Takes in how deep it is pressed in m, below zero how far the tissue is from it; without anything near it
    /// is nothing.
    pub(crate) fn feel(&mut self, depth: Option<f64>, spacing: f64) {
        self.gap = depth.map_or(0.0, |d| (-d).max(0.0));
        // Tissue that is on its way after a tool would get past it unseen if that forgot it.
        let lost = LOST * self.radius.max(0.5 * spacing);
        self.touching &= depth.is_some() && self.gap < lost;
    }

    fn go(&mut self, surface: &Surface<'_>) -> bool {
        let spacing = surface.topology.model().spacing_m;
        let stride = TRAVEL * self.radius.max(0.5 * spacing);
        if !self.placed {
            self.place(surface);
            self.before = self.at;
        }
        let way = self.target - self.at;
        let length = way.norm();
        if length == 0.0 {
            // What it had lost may have come after it.
            self.touching = self.touching || self.touches(surface, spacing);
            return false;
        }
        if self.touching {
            let deeper = self.depth > WAIT * stride && length > WAIT * stride;
            if deeper {
                return false;
            }
            self.at += way * (stride / length).min(1.0);
            if length <= stride {
                self.at = self.target;
            }
            return true;
        }
        let steps = (length / stride).ceil() as usize;
        if steps > MARCH_MAX {
            self.at = self.target;
            self.place(surface);
            return true;
        }
        let from = self.at;
        for s in 1..=steps {
            self.at = if s == steps {
                self.target
            } else {
                from + way * (s as f64 / steps as f64)
            };
            if self.touches(surface, spacing) {
                self.touching = true;
                break;
            }
        }
        true
    }

    /// Puts a tool without history where it is, or outside the surface if it is inside.
    fn place(&mut self, surface: &Surface<'_>) {
        self.placed = true;
        self.touching = false;
        if let Some(foot) = surface.nearest(self.at, f64::MAX) {
            let away = self.at - foot.at;
            if away.dot(&foot.normal) < 0.0 {
                self.at = foot.at + foot.normal * self.radius;
                self.touching = true;
            } else if away.norm() < self.radius {
                self.touching = true;
            }
        }
    }

    fn touches(&self, surface: &Surface<'_>, spacing: f64) -> bool {
        if self.is_point(spacing) {
            let reach = self.radius + 0.5 * spacing;
            return surface
                .nearest(self.at, reach)
                .is_some_and(|foot| (self.at - foot.at).dot(&foot.normal) < self.radius);
        }
        surface.any_near(self.at, self.radius, |triangle| {
            let corners = surface.corners(triangle);
            let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
            let facing = (self.at - middle).dot(&area_normal(&corners)) > 0.0;
            facing
                && super::sample::weights_of(self.radius, spacing)
                    .iter()
                    .any(|w| {
                        let x = super::surface::blend(&corners, w);
                        (x - self.at).norm_squared() < self.radius * self.radius
                    })
        })
    }
}

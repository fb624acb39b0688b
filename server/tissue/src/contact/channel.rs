//! The channel of an inserted needle: material points along it, and their ties to the shaft.
//!
//! A needle opens tissue by its width w = 2 R, so a tip that advances feels the toughness times w (Azar and Hayward 2008).
//! A tip with less force carries the surface along and dents it. Along the shaft the tissue slides with dry friction
//! (`DiMaio` and Salcudean 2003), and across it the tissue moves with the needle:
//!
//! ```text
//! across    f = -κ d                                   d: distance from the axis
//! along     |f| <= τ 2 π R per length                  τ: traction of the material, static until it slides
//! tip       0 <= f <= J w against the advance          J: toughness of the material before the tip
//! ```
//!
//! The last two are ties of stiffness κ that yield: beyond its limit, the place on the shaft where a tie holds without
//! force moves at the end of a step (the return mapping of perfect plasticity). All ties are convex energies of the
//! tissue in a step, and no closed path of the needle gains energy.
//!
//! A point near the tip is tied across by the part c of its pitch that the shaft covers, with the stiffness c κ. Where a
//! tip advances and c grows to c', the new part is tied without force: the point moves towards the axis, to c / c' of
//! its distance. The force stays, and the energy of the tie falls to c / c' of its value. A tip that returns needs no
//! force in its former channel; farther from it than the radius of the needle, it cuts a new one.

use std::f64::consts::PI;

use super::core::Core;
use super::tie::{Held, Tie};
use crate::cell::NO_CELL;
use crate::cut::trilinear::{invert, point};
use crate::{Material, Topology, Vec3};

/// Stiffness of a tie relative to that of the nodes: the samples of one contact together have about this stiffness.
const HOLD: f64 = 5.0;
/// Part of the dynamic limit below which a sliding tie sticks again.
const STICKS: f64 = 0.9;
/// Distance of the end of the tip from the surface at which the needle is out, in pitches.
const OUT: f64 = 0.25;
/// Change of a force at the end of a step, in N, after which the tissue is solved again.
const CHANGED_N: f64 = 1e-3;
/// Most points of a channel; those of a long needle on a fine lattice are farther apart.
const POINTS_MAX: f64 = 256.0;
/// How far outside a cell a point may be by rounding, in cells.
const ROUNDING: f64 = 1e-9;
/// Most cells that a search passes: a straight line through a large model.
const WALK_MAX: usize = 64;
/// Trial steps along the axis in search of the surface, per pitch.
const TRIALS_PER_PITCH: f64 = 4.0;

/// A needle in a pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rod {
    pub(super) tip: Vec3,
    /// From the tip up the shaft.
    pub(super) axis: Vec3,
    pub(super) radius_m: f64,
    pub(super) length_m: f64,
    /// Distance between the points of its channel.
    pub(super) pitch_m: f64,
}

impl Rod {
    /// The needle with this core, of this radius; `None` for a core that is no line.
    pub(super) fn of(core: &Core, radius_m: f64, spacing_m: f64) -> Option<Self> {
        let length_m = 2.0 * core.a.norm();
        Some(Self {
            tip: core.mid - core.a,
            axis: core.a.try_normalize(1e-9)?,
            radius_m,
            length_m,
            pitch_m: spacing_m.max(length_m / POINTS_MAX),
        })
    }

    fn at(&self, along_m: f64) -> Vec3 {
        self.tip + self.axis * along_m
    }

    fn along(&self, x: &Vec3) -> f64 {
        self.axis.dot(&(x - self.tip))
    }

    /// From the axis to a point, across the shaft.
    fn across(&self, x: &Vec3) -> Vec3 {
        x - self.at(self.along(x))
    }

    /// The force that a tip needs to advance in a material, N.
    pub(super) fn cutting_n(&self, material: &Material) -> f64 {
        if material.is_penetrable() {
            material.toughness_j_m2 * 2.0 * self.radius_m
        } else {
            f64::INFINITY
        }
    }
}

/// The tissue that a needle is in.
#[derive(Clone, Copy)]
pub(super) struct Around<'a> {
    pub(super) topology: &'a Topology,
    pub(super) u: &'a [Vec3],
    /// Stiffness of every node, N/m.
    pub(super) own: &'a [f64],
}

impl Around<'_> {
    fn material(&self, cell: u32) -> &Material {
        self.topology.model().material_of(cell as usize)
    }

    /// The point at this place, searched from a cell on through the uncut tissue; `None` outside and in a wound.
    fn locate(&self, world: &Vec3, from: u32) -> Option<Point> {
        let (mut cell, mut previous) = (from, NO_CELL);
        for _ in 0..WALK_MAX {
            let nodes = self.topology.corners(cell);
            let deformed = nodes.map(|n| self.topology.rest(n) + self.u[n as usize]);
            let local = invert(&deformed, world)?;
            let out = local.map(|v| (v - 0.5).abs() - 0.5);
            if out.max() <= ROUNDING {
                return Some(Point { cell, local });
            }
            let mut axes = [0, 1, 2];
            axes.sort_by(|&a, &b| out[b].total_cmp(&out[a]));
            let neighbours = self.topology.model().cells[cell as usize].neighbours;
            let next = axes
                .into_iter()
                .filter(|&a| out[a] > ROUNDING)
                .map(|a| neighbours[2 * a + usize::from(local[a] > 0.5)])
                .find(|&next| next != NO_CELL)?;
            if next == previous {
                // Between the two sides of a wound.
                return None;
            }
            (previous, cell) = (cell, next);
        }
        None
    }

    fn position(&self, at: &Point) -> Vec3 {
        let nodes = self.topology.corners(at.cell);
        let deformed = nodes.map(|n| self.topology.rest(n) + self.u[n as usize]);
        point(&deformed, &at.local)
    }
}

/// A material point: a place in a cell, which cuts keep.
#[derive(Debug, Clone, Copy)]
struct Point {
    cell: u32,
    local: Vec3,
}

/// A material point that is tied to the shaft.
#[derive(Debug, Clone, Copy)]
struct Anchor {
    at: Point,
    /// Distance from the tip, up the shaft, at which the tie has no force along it, m.
    home_m: f64,
    /// Stiffness of its ties, N/m.
    stiffness: f64,
    /// Part of the stiffness that ties it across.
    covered: f64,
    /// Limit of the force along the shaft, N.
    limit_n: f64,
    /// Whether the tissue slides along the shaft here.
    slides: bool,
}

impl Anchor {
    fn new(at: Point, home_m: f64) -> Self {
        Self {
            at,
            home_m,
            stiffness: 0.0,
            covered: 0.0,
            limit_n: 0.0,
            slides: false,
        }
    }

    /// A point on the axis, without a force in this pose.
    fn on_axis(at: Point, along_m: f64, rod: &Rod) -> Self {
        Self {
            covered: covered(along_m, rod),
            ..Self::new(at, along_m)
        }
    }

    /// Ties this part of it across: a new part without force. Where no tissue is, nothing new is tied.
    fn cover(&mut self, around: &Around<'_>, rod: &Rod, covered: f64) {
        if covered > self.covered {
            let x = around.position(&self.at);
            let moved = x - rod.across(&x) * (1.0 - self.covered / covered);
            let Some(at) = around.locate(&moved, self.at.cell) else {
                return;
            };
            self.at = at;
        }
        self.covered = covered;
    }
}

/// Events at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct ChannelChange {
    /// A force has changed: the tissue is not in equilibrium.
    pub(super) is_unsettled: bool,
    /// The needle has left the tissue.
    pub(super) is_out: bool,
}

/// The channel of a needle.
#[derive(Debug, Clone)]
pub(crate) struct Channel {
    /// Each for the pitch around it, from the entry down; the last ones may be before the tip.
    anchors: Vec<Anchor>,
    /// The material that the tip cuts next; `None` beyond the tissue.
    tip: Option<Anchor>,
}

impl Channel {
    /// The channel along a needle that enters, or is found, in this pose. `from` is a cell near the tip, and `pressed_n` the
    /// force of the tissue on the tip, N. `None` if no tissue is at the tip.
    pub(super) fn along(around: &Around<'_>, rod: &Rod, from: u32, pressed_n: f64) -> Option<Self> {
        let pitch = rod.pitch_m;
        let step = pitch / TRIALS_PER_PITCH;
        // A tip presses by its radius before it is in the tissue.
        let trials = (rod.radius_m / step).ceil() as usize + 2;
        let mut trials = (0..trials).map(|i| -(i as f64) * step);
        let (low, first) = trials.find_map(|z| Some((z, around.locate(&rod.at(z), from)?)))?;
        let (mut top, mut cell) = (low, first.cell);
        while top + step <= rod.length_m
            && let Some(found) = around.locate(&rod.at(top + step), cell)
        {
            cell = found.cell;
            top += step;
        }
        let mut channel = Self {
            anchors: Vec::new(),
            tip: None,
        };
        let mut z = top - 0.5 * pitch;
        while z >= -0.5 * pitch {
            if let Some(at) = around.locate(&rod.at(z), cell) {
                channel.anchors.push(Anchor::on_axis(at, z, rod));
                cell = at.cell;
            }
            z -= pitch;
        }
        if channel.anchors.is_empty() {
            // A flap may be thinner than half a pitch.
            channel.anchors.push(Anchor::on_axis(first, low, rod));
        }
        let limit_n = rod.cutting_n(around.material(first.cell));
        let stiffness = stiffness_at(around, &first);
        let held_n = pressed_n.min(limit_n);
        channel.tip = Some(Anchor {
            stiffness,
            limit_n,
            ..Anchor::new(first, low - held_n / stiffness)
        });
        Some(channel)
    }

    /// Adds its ties in this pose, for proxy `proxy`.
    pub(super) fn hold(&mut self, around: &Around<'_>, rod: &Rod, proxy: u32, to: &mut Vec<Held>) {
        let first = rod.axis.cross(&least_axis(&rod.axis)).normalize();
        let across = [first, rod.axis.cross(&first)];
        let tie = |direction: Vec3, home_m: f64, stiffness: f64, limits: [f64; 2]| Tie {
            direction,
            target: direction.dot(&rod.tip) + home_m,
            stiffness,
            limits,
        };
        let free = [f64::NEG_INFINITY, f64::INFINITY];
        let place = |anchor: &Anchor| rod.along(&around.position(&anchor.at));
        self.leave_old_channel(around, rod);
        let places: Vec<f64> = self.anchors.iter().map(place).collect();
        for (i, anchor) in self.anchors.iter_mut().enumerate() {
            let along_m = places[i];
            // The shaft from halfway to the point above to halfway to the point below.
            let halfway = |other: Option<&f64>, outer: f64| {
                other.map_or(along_m + outer, |other| 0.5 * (along_m + other))
            };
            let above = halfway(i.checked_sub(1).map(|i| &places[i]), 0.5 * rod.pitch_m);
            let below = halfway(places.get(i + 1), -0.5 * rod.pitch_m);
            let length_m = (above - below.max(0.0)).max(0.0);
            anchor.cover(around, rod, covered(along_m, rod));
            let [at_rest, sliding] = around.material(anchor.at.cell).needle_traction_pa();
            let traction = if anchor.slides { sliding } else { at_rest };
            anchor.stiffness = stiffness_at(around, &anchor.at);
            anchor.limit_n = traction * 2.0 * PI * rod.radius_m * length_m;
            if length_m == 0.0 {
                (anchor.home_m, anchor.slides) = (along_m, false);
            }
            let [a, b] = across.map(|n| tie(n, 0.0, anchor.covered * anchor.stiffness, free));
            let limits = [-anchor.limit_n, anchor.limit_n];
            let c = tie(rod.axis, anchor.home_m, anchor.stiffness, limits);
            to.push(held(around, anchor, proxy, [a, b, c]));
        }
        if let Some(tip) = &mut self.tip {
            tip.limit_n = rod.cutting_n(around.material(tip.at.cell));
            tip.stiffness = stiffness_at(around, &tip.at);
            let c = tie(rod.axis, tip.home_m, tip.stiffness, [-tip.limit_n, 0.0]);
            // A point that presses does not slide.
            let is_pressed = rod.along(&around.position(&tip.at)) > tip.home_m;
            tip.cover(around, rod, if is_pressed { 1.0 } else { 0.0 });
            let [a, b] = across.map(|n| tie(n, 0.0, tip.covered * tip.stiffness, free));
            to.push(held(around, tip, proxy, [a, b, c]));
        }
    }

    /// A tip that returns beside its former channel cuts a new one.
    fn leave_old_channel(&mut self, around: &Around<'_>, rod: &Rod) {
        let is_left = |anchor: &Anchor| {
            let x = around.position(&anchor.at);
            let is_reached = anchor.covered == 0.0 && covered(rod.along(&x), rod) > 0.0;
            is_reached && rod.across(&x).norm() > rod.radius_m
        };
        let first = self.anchors.iter().skip(1).position(is_left);
        if let Some(above) = first {
            self.anchors.truncate(above + 1);
            let at = around.locate(&rod.tip, self.anchors[above].at.cell);
            self.tip = at.map(|at| Anchor::new(at, 0.0));
        }
    }

    /// Ends a step: ties beyond their limits slide, and the tip cuts.
    pub(super) fn slide(&mut self, around: &Around<'_>, rod: &Rod) -> ChannelChange {
        let mut change = ChannelChange::default();
        for anchor in self.anchors.iter_mut().filter(|a| a.limit_n > 0.0) {
            let along_m = rod.along(&around.position(&anchor.at));
            let pull_n = anchor.stiffness * (along_m - anchor.home_m);
            let [at_rest, sliding] = around.material(anchor.at.cell).needle_traction_pa();
            let traction = if anchor.slides { sliding } else { at_rest };
            let sliding_n = anchor.limit_n * sliding / traction;
            if pull_n.abs() >= anchor.limit_n {
                change.is_unsettled |= anchor.limit_n - sliding_n > CHANGED_N;
                anchor.home_m = along_m - pull_n.signum() * sliding_n / anchor.stiffness;
                anchor.slides = true;
            } else if pull_n.abs() < STICKS * sliding_n {
                anchor.slides = false;
            }
        }
        self.advance(around, rod, &mut change);
        let is_open = |tip: Anchor| rod.along(&around.position(&tip.at)) < tip.home_m;
        let entry_m = self.entry_m(around, rod);
        if entry_m <= 0.0 && self.tip.is_none_or(is_open) {
            change.is_out = entry_m < -(rod.radius_m + OUT * rod.pitch_m);
            // Lifted off, it touches the surface again where it comes down.
            if let Some(new) = Self::along(around, rod, self.anchors[0].at.cell, 0.0) {
                *self = new;
            }
        }
        change
    }

    /// The tip cuts where its force has reached the limit.
    fn advance(&mut self, around: &Around<'_>, rod: &Rod, change: &mut ChannelChange) {
        let last = self.anchors[self.anchors.len() - 1];
        let mut last_m = rod.along(&around.position(&last.at));
        let mut cell = last.at.cell;
        match self.tip {
            Some(tip) => {
                let along_m = rod.along(&around.position(&tip.at));
                if tip.stiffness * (along_m - tip.home_m) < tip.limit_n {
                    return;
                }
                // Before it is in the tissue, a tip presses by its radius on a point that it slides on towards.
                let ahead = Some((tip.at, along_m)).filter(|_| along_m < 0.0);
                let reached = around.locate(&rod.tip, tip.at.cell).map(|at| (at, 0.0));
                self.tip = reached.or(ahead).map(|(at, along_m)| {
                    let stiffness = stiffness_at(around, &at);
                    let held_n = tip.limit_n.min(rod.cutting_n(around.material(at.cell)));
                    change.is_unsettled |= tip.limit_n - held_n > CHANGED_N;
                    Anchor {
                        covered: tip.covered,
                        ..Anchor::new(at, along_m - held_n / stiffness)
                    }
                });
                change.is_unsettled |= self.tip.is_none();
            }
            // A tip beyond the tissue may enter it again; one in its channel cuts nothing.
            None if last_m > 0.0 => {
                let at = around.locate(&rod.tip, cell);
                self.tip = at.map(|at| Anchor::new(at, 0.0));
            }
            None => return,
        }
        while last_m >= 0.5 * rod.pitch_m {
            let next_m = last_m - rod.pitch_m;
            let Some(at) = around.locate(&rod.at(next_m), cell) else {
                break;
            };
            self.anchors.push(Anchor::on_axis(at, next_m, rod));
            (last_m, cell) = (next_m, at.cell);
        }
    }

    /// Distance of the entry from the tip, up the shaft, m.
    pub(super) fn entry_m(&self, around: &Around<'_>, rod: &Rod) -> f64 {
        rod.along(&around.position(&self.anchors[0].at)) + 0.5 * rod.pitch_m
    }

    /// Greatest friction along the shaft, N.
    pub(super) fn friction_n(&self) -> f64 {
        self.anchors.iter().map(|a| a.limit_n).sum()
    }
}

/// Part of the pitch around a point at this distance from the tip that the shaft covers.
fn covered(along_m: f64, rod: &Rod) -> f64 {
    (along_m / rod.pitch_m + 0.5).clamp(0.0, 1.0)
}

fn stiffness_at(around: &Around<'_>, at: &Point) -> f64 {
    let nodes = around.topology.corners(at.cell);
    let weights = crate::cut::trilinear::weights(&at.local);
    let mean = nodes
        .iter()
        .zip(weights)
        .map(|(&n, w)| around.own[n as usize] * w);
    HOLD * mean.sum::<f64>()
}

fn held(around: &Around<'_>, anchor: &Anchor, proxy: u32, ties: [Tie; 3]) -> Held {
    let nodes = around.topology.corners(anchor.at.cell);
    let weights = crate::cut::trilinear::weights(&anchor.at.local);
    let rest = point(&nodes.map(|n| around.topology.rest(n)), &anchor.at.local);
    Held::new(nodes, weights, rest, proxy, ties)
}

/// The axis of coordinates that is farthest from a direction.
fn least_axis(direction: &Vec3) -> Vec3 {
    let mut axis = Vec3::zeros();
    axis[direction.iamin()] = 1.0;
    axis
}

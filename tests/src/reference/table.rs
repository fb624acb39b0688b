//! The table: two hands over one copy of the tissue, or over one each.

use palpate_client::replica::hand_budget;
use palpate_client::{Replica, ToolAt};
use palpate_device::{DeviceFault, Sample};
use palpate_haptics::ContactModel;
use palpate_protocol::ClientTime;
use palpate_protocol::operation::Operation;
use palpate_protocol::request::CutRequest;
use palpate_tissue::{Budget, TopologyHash as TissueHash, Vec3};

use super::check::Ratios;
use super::seat::Seat;
use super::{ReferenceError, operation};

/// The tick of hands and chains, µs.
const TICK_US: i64 = 1000;

/// Ticks between two solves at least: those of a session.
const SOLVE_EVERY: i64 = 4;

/// Ticks between two calls about the progress.
const PROGRESS_EVERY: i64 = 20;

/// Iterations of a solve at most.
const ITERATIONS: usize = 4;

/// Residual near the tools at which a solve ends.
const TOLERANCE: f64 = 2e-2;

/// A turn counts as the way of a point so far from the pivot, m: the far end of a long tool.
const LEVER_M: f64 = 0.05;

/// When the tissue is solved again.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    /// A tool that has moved so far, m.
    pub(super) moved_m: f64,
    /// Ticks since the last solve.
    pub(super) at_least: i64,
}

impl Pace {
    /// As a session solves.
    pub(super) const STEADY: Self = Self {
        moved_m: 0.0,
        at_least: SOLVE_EVERY,
    };
}

/// A solve of the tissue and what it gave both hands.
#[derive(Debug, Clone)]
pub(super) struct Solve {
    /// When, µs of the table.
    pub(super) us: i64,
    pub(super) tools: [ToolAt; 2],
    pub(super) models: [ContactModel; 2],
}

impl Solve {
    pub(super) fn touches(&self) -> bool {
        self.models.iter().any(ContactModel::in_contact)
    }
}

/// Both hands and the tissue between them.
pub(super) struct Table {
    pub(super) seats: [Seat; 2],
    /// One for both, or one for each.
    copies: Vec<Replica>,
    pace: Pace,
    /// The tools as they were last solved for.
    solved: [ToolAt; 2],
    pub(super) solves: Vec<Solve>,
    /// The cuts with their moments, µs of the table.
    pub(super) cuts: Vec<(i64, Operation)>,
    pub(super) cuts_s: Vec<f64>,
}

impl Table {
    pub(super) fn new(seats: [Seat; 2], copies: Vec<Replica>, pace: Pace) -> Self {
        Self {
            solved: [seats[0].tool, seats[1].tool],
            seats,
            copies,
            pace,
            solves: Vec::new(),
            cuts: Vec::new(),
            cuts_s: Vec::new(),
        }
    }

    pub(super) fn topology_hash(&self) -> TissueHash {
        self.copies[0].topology().hash()
    }

    pub(super) fn go_on(
        &mut self,
        end_us: i64,
        mut progress: impl FnMut(f64) -> bool,
    ) -> Result<(), ReferenceError> {
        let ticks = end_us / TICK_US;
        let mut last = -self.pace.at_least;
        for tick in 0..=ticks {
            let us = tick * TICK_US;
            let [a, b] = &mut self.seats;
            let samples = [a.tick(us)?, b.tick(us)?];
            if tick % SOLVE_EVERY != 0 {
                continue;
            }
            let is_cut = self.take(us, &samples)?;
            if is_cut || tick - last >= self.pace.at_least || self.has_moved() {
                self.solve(us);
                last = tick;
            } else {
                for seat in &mut self.seats {
                    seat.renew(us);
                }
            }
            if tick % PROGRESS_EVERY == 0 && !progress(tick as f64 / ticks as f64) {
                return Err(ReferenceError::Stopped(tick as f64 / ticks as f64));
            }
        }
        Ok(())
    }

    /// Takes over where the tools are, and cuts; returns whether a stroke has ended.
    fn take(&mut self, us: i64, samples: &[Sample; 2]) -> Result<bool, ReferenceError> {
        let mut is_cut = false;
        for (k, sample) in samples.iter().enumerate() {
            if let Some(request) = self.seats[k].take(us, sample) {
                self.cut(us, k, &request)?;
                self.cuts_s.push(self.seats[k].script_s(us));
                is_cut = true;
            }
        }
        Ok(is_cut)
    }

    /// Whether a tool is elsewhere than at the last solve, or its buttons are.
    fn has_moved(&self) -> bool {
        self.seats.iter().zip(&self.solved).any(|(seat, solved)| {
            let moved = (seat.tool.position - solved.position).norm()
                + LEVER_M * seat.tool.orientation.angle_to(&solved.orientation);
            seat.tool.buttons != solved.buttons || moved >= self.pace.moved_m
        })
    }

    fn solve(&mut self, us: i64) {
        let now = ClientTime::from_micros(us);
        let [a, b] = &mut self.seats;
        let tools = [a.tool, b.tool];
        self.solved = tools;
        if let [one] = &mut self.copies[..] {
            let mut budget = Budget {
                near: true,
                ..Budget::new(ITERATIONS, TOLERANCE)
            };
            a.contact = one.haptic_step(now, Some(&a.tool), &[b.tool], budget);
            // The shape is solved for both: the second call only asks what the other hand feels.
            budget = Budget {
                near: true,
                ..Budget::new(0, f64::INFINITY)
            };
            b.contact = one.haptic_step(now, Some(&b.tool), &[a.tool], budget);
            self.solves.push(Solve {
                us,
                tools,
                models: [a.contact, b.contact],
            });
            return;
        }
        let others = [b.tool, a.tool];
        for ((copy, seat), other) in self.copies.iter_mut().zip(&mut self.seats).zip(others) {
            // It ends by iterations and residual, which every run repeats, and not by time.
            let mut never = || false;
            let budget = hand_budget(&mut never);
            seat.contact = copy.haptic_step(now, Some(&seat.tool), &[other], budget);
        }
    }

    /// Cuts every copy by the stroke of the hand at seat `author`.
    fn cut(&mut self, us: i64, author: usize, request: &CutRequest) -> Result<(), ReferenceError> {
        let own = &self.copies[author.min(self.copies.len() - 1)];
        let operation = operation(own, request, self.cuts.len(), author as u16 + 1)?;
        for copy in &mut self.copies {
            copy.apply(&operation)?;
        }
        self.cuts.push((us, operation));
        Ok(())
    }
}

/// Lets fresh hands feel the contact models of `solves`, each times its ratio.
pub(super) fn render(
    seats: &mut [Seat; 2],
    solves: &[Solve],
    ratios: &[Ratios; 2],
    end_us: i64,
) -> Result<(), DeviceFault> {
    let mut solves = solves.iter().peekable();
    for tick in 0..=end_us / TICK_US {
        let us = tick * TICK_US;
        for seat in seats.iter_mut() {
            let sample = seat.tick(us)?;
            // The strokes have been cut already.
            let _ = seat.take(us, &sample);
        }
        if tick % SOLVE_EVERY != 0 {
            continue;
        }
        if let Some(solve) = solves.next_if(|s| s.us <= us) {
            for ((seat, model), ratios) in seats.iter_mut().zip(&solve.models).zip(ratios) {
                seat.contact = scaled(model, ratios.at(us));
            }
        } else {
            for seat in seats.iter_mut() {
                seat.renew(us);
            }
        }
    }
    Ok(())
}

/// A contact model with all forces and stiffnesses times a ratio.
fn scaled(model: &ContactModel, ratio: f64) -> ContactModel {
    let mut scaled = *model;
    for touch in scaled.touches.iter_mut().filter(|t| t.touches) {
        touch.f0 *= ratio;
        touch.stiffness *= ratio;
        touch.damping *= ratio;
        touch.pressed_n *= ratio;
    }
    scaled.couple *= ratio;
    scaled
}

/// The force of a contact model, N.
pub(super) fn pressed(model: &ContactModel) -> f64 {
    let force: Vec3 = model.force();
    force.norm()
}

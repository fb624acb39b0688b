//! Two hands on one replica of the tissue, or on one each.

use palpate_device::Sample;
use palpate_haptics::ContactModel;
use palpate_protocol::ClientTime;
use palpate_protocol::operation::CutStroke;
use palpate_protocol::request::CutRequest;
use palpate_site::{Replica, ToolAt, hand_budget};
use palpate_tissue::Budget;

use super::check::{self, Checks};
use super::seat::Seat;
use super::{Quality, Reference, ReferenceError, apart_m, operation, stroke_at_rest};

const TICK_US: i64 = 1000;

/// Minimum ticks between two solves: those of a session.
const SOLVE_EVERY: i64 = 4;
const PROGRESS_EVERY: i64 = 20;

/// Maximum iterations of a solve near the tools.
const ITERATIONS: usize = 4;

/// Residual at which a solve near the tools ends.
const TOLERANCE: f64 = 2e-2;

#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    pub(super) moved_m: f64,
    /// Maximum ticks since the last solve.
    pub(super) at_least: i64,
    pub(super) check_every: i64,
}

impl Pace {
    /// The schedule of a session, without checks.
    pub(super) const STEADY: Self = Self {
        moved_m: 0.0,
        at_least: SOLVE_EVERY,
        check_every: i64::MAX,
    };
}

pub(super) struct TwoHands {
    pub(super) seats: [Seat; 2],
    /// One replica for both hands, or one each.
    replicas: Vec<Replica>,
    pace: Pace,
    solved: [ToolAt; 2],
    solves: usize,
    checked: i64,
    checks: Checks,
    /// Strokes that replace those of the hands, in order.
    given: Vec<CutStroke>,
    strokes: Vec<CutStroke>,
    cut_apart_m: f64,
    cuts_s: Vec<f64>,
}

impl TwoHands {
    pub(super) fn new(
        seats: [Seat; 2],
        replicas: Vec<Replica>,
        pace: Pace,
        cuts: &[CutStroke],
    ) -> Self {
        Self {
            solved: [seats[0].tool, seats[1].tool],
            seats,
            replicas,
            pace,
            solves: 0,
            checked: 0,
            checks: Checks::default(),
            given: cuts.to_vec(),
            strokes: Vec::new(),
            cut_apart_m: 0.0,
            cuts_s: Vec::new(),
        }
    }

    pub(super) fn into_reference(self) -> Reference {
        Reference {
            quality: Quality {
                solves: self.solves,
                checks: self.checks.count,
                residual_max: self.checks.residual_max,
                error_percent: self.checks.changed_percent(),
            },
            topology_hash: self.replicas[0].topology().hash(),
            cuts_s: self.cuts_s,
            strokes: self.strokes,
            cut_apart_m: self.cut_apart_m,
            forces: self.seats.map(|s| s.forces),
        }
    }

    pub(super) fn run_until(
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

    /// Updates the tool poses, and cuts; returns whether a stroke has ended.
    fn take(&mut self, us: i64, samples: &[Sample; 2]) -> Result<bool, ReferenceError> {
        let mut is_cut = false;
        for (k, sample) in samples.iter().enumerate() {
            if let Some(request) = self.seats[k].take(us, sample) {
                self.cut(k, &request)?;
                self.cuts_s.push(self.seats[k].script_s(us));
                is_cut = true;
            }
        }
        Ok(is_cut)
    }

    /// Whether a tool or its buttons changed since the last solve.
    fn has_moved(&self) -> bool {
        let tools = self.seats.iter().map(|seat| &seat.tool);
        let mut both = tools.zip(&self.solved);
        both.any(|(tool, solved)| !tool.is_within(solved, self.pace.moved_m))
    }

    fn solve(&mut self, us: i64) {
        let now = ClientTime::from_micros(us);
        let [a, b] = &mut self.seats;
        self.solved = [a.tool, b.tool];
        self.solves += 1;
        if let [one] = &mut self.replicas[..] {
            let budget = Budget {
                near: true,
                ..Budget::new(ITERATIONS, TOLERANCE)
            };
            let [first, second] = solve_both(one, now, &self.solved, budget);
            (a.contact, b.contact) = (first, second);
            let touches = first.in_contact() || second.in_contact();
            if touches && us / TICK_US - self.checked >= self.pace.check_every {
                self.checked = us / TICK_US;
                let budget = Budget::new(check::ITERATIONS, check::TOLERANCE);
                let converged = solve_both(one, now, &self.solved, budget);
                let residual = one.haptic_residual().unwrap_or(f64::INFINITY);
                self.checks.note(residual, &[first, second], &converged);
                [a.contact, b.contact] = converged;
            }
            return;
        }
        let others = [b.tool, a.tool];
        for ((replica, seat), other) in self.replicas.iter_mut().zip(&mut self.seats).zip(others) {
            // Iterations and residual end the solve, not time, so that it is reproducible.
            let mut never = || false;
            let budget = hand_budget(&mut never);
            seat.contact = replica.haptic_step(now, Some(&seat.tool), &[other], budget);
        }
    }

    /// Cuts every replica with the stroke of the hand `author`, or with its replacement.
    fn cut(&mut self, author: usize, request: &CutRequest) -> Result<(), ReferenceError> {
        let own = &self.replicas[author.min(self.replicas.len() - 1)];
        let stroke = stroke_at_rest(own, request);
        let number = self.strokes.len();
        let given = self.given.get(number);
        self.cut_apart_m = given.map_or(self.cut_apart_m, |given| {
            self.cut_apart_m.max(apart_m(&stroke, given))
        });
        let stroke = given.cloned().unwrap_or(stroke);
        self.strokes.push(stroke.clone());
        let operation = operation(own, stroke, number, author as u16 + 1)?;
        for replica in &mut self.replicas {
            replica.apply(&operation)?;
        }
        Ok(())
    }
}

/// Solves for both hands; returns their forces.
fn solve_both(
    replica: &mut Replica,
    now: ClientTime,
    [a, b]: &[ToolAt; 2],
    budget: Budget<'_>,
) -> [ContactModel; 2] {
    let near = budget.near;
    let first = replica.haptic_step(now, Some(a), &[*b], budget);
    // The first call solves for both hands; the second one only reads the force of the other.
    let nothing = Budget {
        near,
        ..Budget::new(0, f64::INFINITY)
    };
    [first, replica.haptic_step(now, Some(b), &[*a], nothing)]
}

//! Two hands on one replica of the tissue, or on one each.

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_device::Sample;
use palpate_haptics::ContactModel;
use palpate_protocol::operation::{BladePoint, CutStroke, Operation, OperationKind};
use palpate_protocol::request::{CutRequest, RequestRefusal, TimedBladePoint};
use palpate_protocol::tool::INSERTED_BUTTON;
use palpate_protocol::{
    ClientTime, OperationId, ParticipantId, RequestId, ServerTime, TopologyHash,
};
use palpate_room::{Authority, CutJob, CutOrder, Cutter, LoggedCut, RequestedChange, TissueReport};
use palpate_site::{Replica, ToolAt, hand_budget, tissue_stroke};
use palpate_tissue::{Budget, CutHistory, Model, Topology, Vec3, to_rest};

use super::check::{self, Checks};
use super::seat::Seat;
use super::{Quality, Reference, ReferenceError, TimedCut, apart_m};

const TICK_US: i64 = 1000;

/// Minimum ticks between two solves: those of a session.
const SOLVE_EVERY: i64 = 4;
const PROGRESS_EVERY: i64 = 20;

/// Maximum iterations of a solve near the tools: with 4 the abdominal wall is 9 instead of 7 % off before its checks.
const ITERATIONS: usize = 12;

/// Residual at which a solve near the tools ends.
const TOLERANCE: f64 = 2e-2;

#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    pub(super) moved_m: f64,
    /// Maximum ticks since the last solve.
    pub(super) at_least: i64,
    /// Maximum ticks, and maximum motion of a tool in m, between two checks in contact.
    pub(super) check_every: i64,
    pub(super) check_moved_m: f64,
}

impl Pace {
    /// The schedule of a session, without checks.
    pub(super) const STEADY: Self = Self {
        moved_m: 0.0,
        at_least: SOLVE_EVERY,
        check_every: i64::MAX,
        check_moved_m: f64::INFINITY,
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
    checked_tools: [ToolAt; 2],
    checks: Checks,
    /// Cuts the hands' own strokes.
    cutter: Cutter,
    /// Paths of the hands' own blades at rest: parts that were cut, and parts that parted nothing.
    own: Vec<TimedCut>,
    /// Cuts in place of the hands' own; `None` for their own.
    given: Option<GivenCuts>,
    cut: Vec<TimedCut>,
    cuts_s: Vec<f64>,
}

/// Author of all parts of a session, whose strokes begin at different times.
const SESSION: ParticipantId = ParticipantId(0);

fn hand_number(hand: usize) -> ParticipantId {
    ParticipantId(hand as u16 + 1)
}

/// The parts that a session cut.
struct GivenCuts {
    waiting: VecDeque<TimedCut>,
    topology: Arc<Topology>,
    history: CutHistory,
}

impl GivenCuts {
    fn new(model: &Arc<Model>, cuts: &[TimedCut]) -> Self {
        let topology = Arc::new(Topology::new(Arc::clone(model)));
        Self {
            waiting: cuts.iter().cloned().collect(),
            history: CutHistory::new(Arc::clone(&topology)),
            topology,
        }
    }

    /// The next part that is due, and its result.
    fn poll(&mut self, at_s: f64) -> Result<Option<(TimedCut, LoggedCut)>, ReferenceError> {
        let is_due = self.waiting.front().is_some_and(|cut| cut.at_s <= at_s);
        let Some(cut) = is_due.then(|| self.waiting.pop_front()).flatten() else {
            return Ok(None);
        };
        let part = tissue_stroke(SESSION, &cut.part);
        let made = self.history.cut(&mut self.topology, part);
        made.map_err(|e| ReferenceError::Cut(e.to_string()))?;
        let logged = LoggedCut {
            change: OperationKind::Cut(cut.part.clone()),
            version: self.topology.version(),
            hash: TopologyHash(self.topology.hash().0),
            blade_at: None,
        };
        Ok(Some((cut, logged)))
    }
}

impl TwoHands {
    pub(super) fn new(
        model: &Arc<Model>,
        seats: [Seat; 2],
        replicas: Vec<Replica>,
        pace: Pace,
        cuts: &[TimedCut],
    ) -> Self {
        Self {
            solved: [seats[0].tool, seats[1].tool],
            checked_tools: [seats[0].tool, seats[1].tool],
            seats,
            replicas,
            pace,
            solves: 0,
            checked: 0,
            checks: Checks::default(),
            cutter: Authority::new(Arc::clone(model)).1,
            own: Vec::new(),
            given: (!cuts.is_empty()).then(|| GivenCuts::new(model, cuts)),
            cut: Vec::new(),
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
            cut_apart_m: apart_m(self.replicas[0].topology().model(), &self.cut, &self.own),
            cuts_s: self.cuts_s,
            strokes: self.cut,
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

    /// Updates the tool poses, and cuts; returns whether the tissue was cut.
    fn take(&mut self, us: i64, samples: &[Sample; 2]) -> Result<bool, ReferenceError> {
        let before = self.cut.len();
        let at_s = self.seats[0].script_s(us);
        for (k, sample) in samples.iter().enumerate() {
            let Some(request) = self.seats[k].take(us, sample) else {
                continue;
            };
            if request.is_last {
                self.cuts_s.push(at_s);
            }
            let path = self.path_at_rest(k, &request);
            let logged = self.cut_own(k, request)?;
            if logged.is_none() {
                self.own.extend(path.map(|part| TimedCut { at_s, part }));
            }
            if let Some(logged) = logged
                && let OperationKind::Cut(part) = &logged.change
            {
                let part = part.clone();
                self.own.push(TimedCut {
                    at_s,
                    part: part.clone(),
                });
                if self.given.is_none() {
                    self.apply(hand_number(k), &logged)?;
                    self.cut.push(TimedCut { at_s, part });
                }
            }
        }
        while let Some((cut, logged)) = self.given.as_mut().map_or(Ok(None), |g| g.poll(at_s))? {
            self.apply(SESSION, &logged)?;
            self.cut.push(cut);
        }
        Ok(self.cut.len() > before)
    }

    /// Whether a tool or its buttons changed since the last solve.
    fn has_moved(&self) -> bool {
        let tools = self.seats.iter().map(|seat| &seat.tool);
        let mut both = tools.zip(&self.solved);
        both.any(|(tool, solved)| !tool.is_within(solved, self.pace.moved_m))
    }

    /// Whether a check is due.
    fn is_check_due(&self, us: i64) -> bool {
        let has_moved = |(seat, checked): (&Seat, &ToolAt)| {
            seat.contact.in_contact() && !seat.tool.is_within(checked, self.pace.check_moved_m)
        };
        us / TICK_US - self.checked >= self.pace.check_every
            || self.seats.iter().zip(&self.checked_tools).any(has_moved)
    }

    fn solve(&mut self, us: i64) {
        let now = ClientTime::from_micros(us);
        let is_check_due = self.is_check_due(us);
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
            if touches && is_check_due {
                self.checked = us / TICK_US;
                self.checked_tools = self.solved;
                let budget = Budget::new(check::ITERATIONS, check::TOLERANCE);
                let converged = solve_both(one, now, &self.solved, budget);
                let residual = one.haptic_residual().unwrap_or(f64::INFINITY);
                self.checks.note(residual, &[first, second], &converged);
                [a.contact, b.contact] = converged;
            }
            return;
        }
        let others = [b.tool, a.tool].map(|tool| ToolAt {
            predicted: None,
            ..tool
        });
        for ((replica, seat), other) in self.replicas.iter_mut().zip(&mut self.seats).zip(others) {
            // Iterations and residual end the solve, not time, so that it is reproducible.
            let mut never = || false;
            let budget = hand_budget(&mut never);
            seat.contact = replica.haptic_step(now, Some(&seat.tool), &[other], budget);
        }
    }

    /// The path of a part of the stroke of a hand, as far as it is in or near the tissue. Another run may cut where this
    /// part parts nothing.
    fn path_at_rest(&self, hand: usize, request: &CutRequest) -> Option<CutStroke> {
        let replica = &self.replicas[hand.min(self.replicas.len() - 1)];
        let (topology, shape) = (replica.topology(), replica.haptic_shape()?);
        let at_rest = |point: &TimedBladePoint| {
            let tip = to_rest(topology, shape, Vec3::from(point.blade.tip_m))?.position;
            Some(BladePoint {
                tip_m: tip.into(),
                ..point.blade
            })
        };
        Some(CutStroke {
            began: request.began,
            joins: false,
            points: request.points.iter().filter_map(at_rest).collect(),
            width_m: request.width_m,
        })
    }

    /// Cuts the own topology with a part of the stroke of a hand, as the room does; `None` if that parts nothing.
    fn cut_own(
        &mut self,
        hand: usize,
        request: CutRequest,
    ) -> Result<Option<LoggedCut>, ReferenceError> {
        let replica = &self.replicas[hand.min(self.replicas.len() - 1)];
        let Some(shape) = replica.haptic_shape() else {
            return Ok(None);
        };
        let order = CutOrder {
            author: hand_number(hand),
            request: RequestId(0),
            change: RequestedChange::Cut(request),
        };
        let job = CutJob::new(&order, replica.topology(), shape);
        match self.cutter.make(&job).0 {
            TissueReport::Cut { result, .. } => match result {
                Ok(logged) => Ok(Some(logged)),
                Err(RequestRefusal::NothingCut | RequestRefusal::CanNotCut(_)) => Ok(None),
                Err(refusal) => Err(ReferenceError::Cut(refusal.to_string())),
            },
            TissueReport::Settled { .. }
            | TissueReport::Prepared { .. }
            | TissueReport::Snapshot { .. } => Ok(None),
        }
    }

    /// Cuts every replica.
    fn apply(&mut self, author: ParticipantId, logged: &LoggedCut) -> Result<(), ReferenceError> {
        let operation = Operation {
            id: OperationId(self.cut.len() as u64),
            at: ServerTime::ZERO,
            author,
            topology_version_before: logged.version - 1,
            topology_version_after: logged.version,
            hash_after: logged.hash,
            kind: logged.change.clone(),
        };
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
    let mut a = *a;
    a.buttons &= !INSERTED_BUTTON;
    if first.is_inserted {
        a.buttons |= INSERTED_BUTTON;
    }
    // The first call solves for both hands; the second one only reads the force of the other.
    let nothing = Budget {
        near,
        ..Budget::new(0, f64::INFINITY)
    };
    [first, replica.haptic_step(now, Some(b), &[a], nothing)]
}

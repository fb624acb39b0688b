//! Demotion to spectator: a participant with a slow network does not raise the playout delay of the group.
//!
//! A participant can shorten or lengthen only its own path by false reports or sample times: the requirement of a pair
//! counts for the longer round trip, and the playout delay follows reports only as far as measured paths explain them.
//!
//! A delay report of x covers the path from every other participant to x, so it includes their uplinks. The
//! server therefore separates uplink and downlink. The requirement of a pair counts for the participant with the
//! longer round trip (our own rule):
//!
//! ```text
//! uplink(x)       age of x's samples on arrival at the server, measured by the server
//! downlink(x)     reported requirement of x, less the largest uplink of the other participants, at most the measured
//!                 round trip of x less its uplink
//! pair(x,y)       max( uplink(x) + downlink(y), uplink(y) + downlink(x) )
//! requirement(x)  max( uplink(x), pair(x,y) for every y with a shorter uplink + downlink than x )
//! ```
//!
//! All ages exclude stalls of machines ([`palpate_protocol::lateness`]): a stalled machine is no reason to demote.
//! The requirement of an active participant remembers bursts. Demoted participants are judged on current lateness, mean
//! plus four deviations. A demoted participant may receive no motion and so report nothing: its downlink is then the
//! last known one or the current uplink, whichever is shorter.
//!
//! A clock error lengthens the uplink by the amount by which it shortens the downlink, so it changes no sum.

use palpate_protocol::compensation::{DemotionDecision, REPORT_OLD};
use palpate_protocol::operation::{CompensationMode, OperationKind};
use palpate_protocol::request::DelayReport;
use palpate_protocol::{ParticipantId, ServerTime, Span};

use super::Room;
use crate::limits::Limit;
use crate::participant::Participant;

/// Time between two decisions: the period of delay reports.
const DECISION_PERIOD: Span = Span::from_millis(250);

/// After a demotion, delay reports of all participants are ignored for this time, because they still include the
/// demoted one.
const REPORTS_IGNORED: Span = Span::from_millis(1000);

/// Uplink and downlink of a participant, µs.
#[derive(Debug, Clone, Copy)]
struct PathDelay {
    who: ParticipantId,
    uplink: i64,
    downlink: i64,
    is_demoted: bool,
    /// Whether any delay was measured. An unknown path counts as zero and is not judged.
    is_known: bool,
}

impl PathDelay {
    /// Whether the requirement of the pair counts for this participant: the longer round trip, of equal ones the
    /// participant that joined later.
    fn answers_for(&self, other: &Self) -> bool {
        self.is_demoted
            || (self.uplink + self.downlink, self.who) > (other.uplink + other.downlink, other.who)
    }

    /// Delay requirement that counts for this participant, µs.
    fn requirement(&self, all: &[Self]) -> i64 {
        let others = all
            .iter()
            .filter(|y| y.who != self.who && !y.is_demoted && self.answers_for(y));
        let pairs = others.map(|y| (self.uplink + y.downlink).max(y.uplink + self.downlink));
        pairs.max().unwrap_or(0).max(self.uplink)
    }
}

/// Delay requirement of a participant, µs; of a demoted one the current requirement without memory.
fn wanted_now(report: &DelayReport, of: &Participant) -> i64 {
    let wanted = i64::from(report.wanted_us);
    let late = i64::from(report.mean_us) + 4 * i64::from(report.deviation_us);
    if of.demotion.is_demoted() {
        wanted.min(late)
    } else {
        wanted
    }
}

impl Room {
    /// Handles a delay report of a client. Only those of participants with a tool count.
    pub(super) fn note_report(&mut self, who: ParticipantId, report: DelayReport, now: ServerTime) {
        let longest = self.longest_uplink_beside(who);
        let seat = self.participants.get_mut(&who);
        let Some(participant) = seat.filter(|p| p.tool.is_some()) else {
            return;
        };
        if let Some((_, before)) = participant.report.replace((now, report))
            && (participant.explained(before, longest)).is_some_and(|used| used != before)
        {
            self.limits.count(Limit::DelayReport);
        }
    }

    /// Passes the reports on to the group, as far as the measured paths explain them by now: the longest uplink of the
    /// other participants and the own round trip. A report of a slower path may arrive before its measurement.
    pub(super) fn pass_reports(&mut self) {
        let active = self.participants.values().filter(|p| {
            !p.demotion.is_demoted()
                && p.report
                    .is_some_and(|(at, _)| at >= self.reports_count_from)
        });
        for participant in active {
            let longest = self.longest_uplink_beside(participant.id);
            let report = participant.report.map(|(_, report)| report);
            if let Some(explained) = report.and_then(|r| participant.explained(r, longest)) {
                self.group.handle_report(participant.id, explained);
            }
        }
        let active = self
            .participants
            .values()
            .filter(|p| !p.demotion.is_demoted());
        let paths = active.filter_map(|p| p.path_max_us(self.longest_uplink_beside(p.id)));
        self.group
            .bound_predictions(paths.max().unwrap_or(u32::MAX));
    }

    /// The longest explained uplink of the other active participants.
    fn longest_uplink_beside(&self, who: ParticipantId) -> Span {
        let others = self
            .participants
            .values()
            .filter(|p| p.id != who && !p.demotion.is_demoted());
        let uplinks = others.filter_map(Participant::explained_uplink);
        let us = uplinks.map(|r| r.wanted_us).max().unwrap_or(0);
        Span::from_micros(i64::from(us))
    }

    /// Demotes and restores participants.
    pub(super) fn decide_demotions(&mut self, now: ServerTime) {
        if now < self.next_demotion_decision {
            return;
        }
        self.next_demotion_decision = now + DECISION_PERIOD;
        self.forget_old_reports(now);
        let is_adaptive = matches!(
            self.config.compensation.mode,
            CompensationMode::Adaptive { .. }
        );
        // Only adaptive compensation has a cap.
        if !is_adaptive {
            return;
        }
        let path_delays = self.path_delays();
        for path in path_delays.iter().filter(|w| w.is_known) {
            let Some(participant) = self.participants.get_mut(&path.who) else {
                continue;
            };
            let requirement = Span::from_micros(path.requirement(&path_delays));
            match participant.demotion.handle_wanted(requirement, now) {
                Some(DemotionDecision::Demote { wanted, cap }) => {
                    self.demote(path.who, wanted, cap, now);
                }
                Some(DemotionDecision::Restore) => self.restore(path.who, now),
                None => {}
            }
        }
    }

    /// Drops old reports: a client that receives no motion sends none.
    fn forget_old_reports(&mut self, now: ServerTime) {
        for participant in self.participants.values_mut() {
            if participant
                .report
                .is_some_and(|(at, _)| now - at > REPORT_OLD)
            {
                participant.report = None;
                self.group.remove(participant.id);
            }
        }
    }

    /// Uplinks and downlinks of the connected participants with a tool.
    fn path_delays(&mut self) -> Vec<PathDelay> {
        let is_active = |p: &&Participant| p.peer().is_some() && p.tool.is_some();
        let here = || self.participants.values().filter(is_active);
        let uplink = |p: &Participant| p.explained_uplink().map(|r| wanted_now(&r, p));
        let mut path_delays = Vec::new();
        for p in here() {
            let wanted = p.report.map(|(_, r)| wanted_now(&r, p));
            let active = here().filter(|y| y.id != p.id && !y.demotion.is_demoted());
            let longest = active.filter_map(uplink).max().unwrap_or(0);
            let own_uplink = uplink(p).unwrap_or(0);
            let downlink = match wanted {
                Some(wanted) => (wanted - longest).clamp(0, p.downlink_max_us(own_uplink)),
                None if p.demotion.is_demoted() => p.downlink_us.min(own_uplink),
                None => 0,
            };
            path_delays.push(PathDelay {
                who: p.id,
                uplink: own_uplink,
                downlink,
                is_demoted: p.demotion.is_demoted(),
                is_known: uplink(p).is_some() || wanted.is_some(),
            });
        }
        for path in &path_delays {
            if let Some(p) = self.participants.get_mut(&path.who)
                && p.report.is_some()
            {
                p.downlink_us = path.downlink;
            }
        }
        path_delays
    }

    fn demote(&mut self, who: ParticipantId, wanted: Span, cap: Span, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        participant.deactivate(now);
        self.fan_out.remove(who);
        self.demotions += 1;
        // Reports in flight still include the demoted participant.
        self.reports_count_from = now + REPORTS_IGNORED;
        let ids: Vec<ParticipantId> = self.participants.keys().copied().collect();
        for id in ids {
            self.group.remove(id);
        }
        let micros = |s: Span| u32::try_from(s.as_micros()).unwrap_or(u32::MAX);
        let kind = OperationKind::Demoted {
            participant: who,
            wanted_us: micros(wanted),
            cap_us: micros(cap),
        };
        self.append(ParticipantId::SERVER, kind, now);
    }

    pub(super) fn restore(&mut self, who: ParticipantId, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        participant.activate(now);
        let kind = OperationKind::Restored { participant: who };
        self.append(ParticipantId::SERVER, kind, now);
    }

    /// Number of demotions.
    pub fn demotion_count(&self) -> u64 {
        self.demotions
    }
}

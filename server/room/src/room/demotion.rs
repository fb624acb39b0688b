//! Who watches for a while because of their network, so that the group's delay does not follow them.
//!
//! A report says what somebody needs to see the others, and so holds the others' way up too: who is slow
//! makes everybody need more. Therefore ways are told apart, and what two need of each other is put down
//! to the one with the longer way (a rule of our own making):
//!
//! ```text
//! up(x)      age of x's samples on arrival here, measured here
//! down(x)    what x reports, less the largest up of the others
//! pair(x,y)  max( up(x) + down(y), up(y) + down(x) )
//! need(x)    max( up(x), pair(x,y) for every y whose up + down is shorter than x's )
//! ```
//!
//! All of them are ages without what machines made of them ([`palpate_protocol::lateness`]): a machine that stalls
//! is no reason to demote. The wanted delay remembers bursts; demoted participants are judged on current lateness, mean
//! and four deviations. Who watches may hear nobody, and reports nothing then: the way down is as long as it was,
//! or as the way up is by now, if that is shorter.
//!
//! An error of a clock makes up longer by what it makes down shorter, and so changes no sum.

use palpate_protocol::compensation::{REPORT_OLD, Verdict};
use palpate_protocol::operation::{CompensationMode, OperationKind};
use palpate_protocol::request::DelayReport;
use palpate_protocol::{ParticipantId, ServerTime, Span};

use super::Room;
use crate::participant::Participant;

/// Between two judgements: as often as reports come.
const JUDGE_PERIOD: Span = Span::from_millis(250);

/// After somebody is lifted the others' reports are passed over for so long: until they know of it, have
/// forgotten what they measured, and say so.
const STILL_SPOKEN_OF: Span = Span::from_millis(1000);

/// What is known of somebody's way to the server and back, µs.
#[derive(Debug, Clone, Copy)]
struct Way {
    who: ParticipantId,
    up: i64,
    down: i64,
    is_demoted: bool,
    /// Whether anything was measured; who is not known is as near as can be to the others, and not judged.
    is_known: bool,
}

impl Way {
    /// Whether what the two need of each other is put down to this one: the longer way, of equal ones that
    /// of who came later.
    fn answers_for(&self, other: &Self) -> bool {
        self.is_demoted || (self.up + self.down, self.who) > (other.up + other.down, other.who)
    }

    /// What is put down to this one, µs.
    fn need(&self, all: &[Self]) -> i64 {
        let others = all
            .iter()
            .filter(|y| y.who != self.who && !y.is_demoted && self.answers_for(y));
        let pairs = others.map(|y| (self.up + y.down).max(y.up + self.down));
        pairs.max().unwrap_or(0).max(self.up)
    }
}

/// What somebody needs, µs; of those who watch, what they would need now.
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
    /// A site says what it needs.
    pub(super) fn note_report(&mut self, who: ParticipantId, report: DelayReport, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        participant.report = Some((now, report));
        if !participant.demotion.is_demoted() && now >= self.heard_from {
            self.group.handle_report(who, report);
        }
    }

    /// Decides who watches from now on, and who gets the tool back.
    pub(super) fn judge(&mut self, now: ServerTime) {
        if now < self.next_judgement {
            return;
        }
        self.next_judgement = now + JUDGE_PERIOD;
        self.forget_old_reports(now);
        let is_adaptive = matches!(
            self.config.compensation.mode,
            CompensationMode::Adaptive { .. }
        );
        // Without a cap nobody is beyond it.
        if !is_adaptive {
            return;
        }
        let ways = self.ways();
        for way in ways.iter().filter(|w| w.is_known) {
            let Some(participant) = self.participants.get_mut(&way.who) else {
                continue;
            };
            // A log that is full lifts no tool any more; who was lifted before still gets it back.
            if !participant.demotion.is_demoted() && !self.log.takes_work() {
                continue;
            }
            let need = Span::from_micros(way.need(&ways));
            match participant.demotion.handle_wanted(need, now) {
                Some(Verdict::Demote { wanted, cap }) => self.demote(way.who, wanted, cap, now),
                Some(Verdict::Restore) => self.restore(way.who, now),
                None => {}
            }
        }
    }

    /// What is no longer said is no longer needed: who hears nobody reports nothing.
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

    /// The ways of those that are connected.
    fn ways(&mut self) -> Vec<Way> {
        let here = || self.participants.values().filter(|p| p.peer().is_some());
        let up = |p: &Participant| p.delay.report().map(|r| wanted_now(&r, p));
        let mut ways = Vec::new();
        for p in here() {
            let wanted = p.report.map(|(_, r)| wanted_now(&r, p));
            let heard = here().filter(|y| y.id != p.id && !y.demotion.is_demoted());
            let longest = heard.filter_map(up).max().unwrap_or(0);
            let own_up = up(p).unwrap_or(0);
            let down = match wanted {
                Some(wanted) => (wanted - longest).max(0),
                None if p.demotion.is_demoted() => p.down_us.min(own_up),
                None => 0,
            };
            ways.push(Way {
                who: p.id,
                up: own_up,
                down,
                is_demoted: p.demotion.is_demoted(),
                is_known: up(p).is_some() || wanted.is_some(),
            });
        }
        for way in &ways {
            if let Some(p) = self.participants.get_mut(&way.who)
                && p.report.is_some()
            {
                p.down_us = way.down;
            }
        }
        ways
    }

    fn demote(&mut self, who: ParticipantId, wanted: Span, cap: Span, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        participant.lift(now);
        self.fan_out.remove(who);
        self.demotions += 1;
        // What the others say for a while still speaks of this one.
        self.heard_from = now + STILL_SPOKEN_OF;
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

    fn restore(&mut self, who: ParticipantId, now: ServerTime) {
        let Some(participant) = self.participants.get_mut(&who) else {
            return;
        };
        participant.set_down(now);
        let kind = OperationKind::Restored { participant: who };
        self.append(ParticipantId::SERVER, kind, now);
    }

    /// How often somebody became a spectator because of their network.
    pub fn demotion_count(&self) -> u64 {
        self.demotions
    }
}

//! A running session: supervised until it is over, then shut down in order.

use std::path::Path;
use std::sync::atomic::Ordering;

use palpate_protocol::session::CloseReason;
use palpate_protocol::{ClientTime, Span};
use palpate_tissue::Staged;
use palpate_transport::threads::{self, CpuTime, Scheduling};

use crate::ending::{Ending, conclude};
use crate::join::Parts;
use crate::motion::MotionThread;
use crate::network::Network;
use crate::realtime::{HapticHandle, LoopSummary, TracePoint, monotonic_now, sleep_until};
use crate::reconnect::Condition;
use crate::recording::{HapticPoint, Recording};
use crate::replica_thread::{End, Part, Progress, ReplicaSummary};
use crate::status::{Figures, HandFigures, Status};
use crate::{ClientError, JoinOptions, Summary};

/// Polling period of the main thread.
const LOOK_AROUND: Span = Span::from_millis(50);

/// A running session.
pub(crate) struct Session<'a> {
    pub(crate) options: &'a JoinOptions,
    pub(crate) network: Network,
    pub(crate) parts: Parts,
    pub(crate) status: Status,
    /// State of the connection at the last poll.
    pub(crate) seen: Condition,
    pub(crate) began: ClientTime,
    /// CPU time of the program at the start of the session.
    pub(crate) cpu_began: CpuTime,
    /// Bytes received and time, as of the last status line.
    pub(crate) came: (u64, ClientTime),
}

impl Session<'_> {
    pub(crate) fn greet(&mut self) {
        let welcome = &self.network.welcome;
        let others = welcome.roster.len().saturating_sub(1);
        let sentence = format!(
            "joined as {} ({}), {others} others here, {} operations so far",
            self.options.name, welcome.role, welcome.operations_so_far
        );
        self.status.say(&sentence);
        let explanation = self
            .parts
            .haptics
            .as_ref()
            .and_then(|h| h.scheduling().explanation());
        if let Some(explanation) = explanation {
            self.status.say(&explanation);
        }
    }

    /// Supervises all threads until the session is over.
    pub(crate) fn supervise(&mut self) -> Ending {
        loop {
            let now = monotonic_now();
            let progress = self.parts.replica.progress();
            if let Some(haptics) = &self.parts.haptics {
                // No force of a replica that differs from the server's is rendered.
                haptics.set_link_lost(progress.link_lost || progress.part == Part::Resyncing);
                if !haptics.is_running() {
                    return Ending::Panicked("force loop");
                }
            }
            for sentence in &progress.notices {
                self.status.say(sentence);
            }
            if self.network.is_broken() {
                return Ending::Panicked("network");
            }
            match progress.end {
                Some(End::Closed(reason)) => return Ending::Closed(reason),
                Some(End::Diverged(detail)) => return Ending::Diverged(detail),
                None => {}
            }
            if !self.parts.replica.is_running() {
                return Ending::Panicked("solver");
            }
            self.report_connection();
            if self.options.stop.load(Ordering::Acquire) {
                return Ending::Wish("you left".to_owned());
            }
            let stayed = now - self.began;
            if let Some(duration) = self.options.duration
                && stayed.as_secs_f64() >= duration.as_secs_f64()
            {
                if let Some(why) = &self.seen.lost {
                    return Ending::Closed(CloseReason::ConnectionLost(why.clone()));
                }
                let sentence = format!("you left after {} s, as asked", duration.as_secs_f64());
                return Ending::Wish(sentence);
            }
            if self.status.is_due(now) {
                let figures = self.figures(stayed, &progress);
                self.status.show(&figures, now);
            }
            sleep_until(now + LOOK_AROUND);
        }
    }

    /// Reports a lost or restored connection.
    fn report_connection(&mut self) {
        let now = self.network.condition.borrow().clone();
        if now == self.seen {
            return;
        }
        if now.returns > self.seen.returns {
            self.status.say("reconnected, in the same seat");
        }
        if let Some(why) = now.lost.as_ref().filter(|_| self.seen.lost.is_none()) {
            self.status.say(&format!(
                "connection lost ({why}); no force; trying to reconnect for {} s",
                self.options.reconnect.as_secs_f64()
            ));
        }
        if now.requests_lost > self.seen.requests_lost {
            self.status.say(
                "your request (a cut or a change of tool) was lost with the connection; please repeat it",
            );
        }
        self.seen = now;
    }

    fn figures(&mut self, stayed: Span, progress: &Progress) -> Figures {
        let hand = self.parts.haptics.as_mut().map(|haptics| {
            let stats = haptics.stats();
            HandFigures {
                rate_hz: stats.rate_hz,
                lateness_p99_us: stats.lateness_us.p99,
                force_n: stats.force_n,
            }
        });
        let stats = *self.network.stats.borrow();
        let link = stats.link;
        let now = monotonic_now();
        let (bytes, since) = std::mem::replace(&mut self.came, (stats.path.received_bytes, now));
        // A smaller count than before belongs to another connection.
        let came = stats.path.received_bytes.saturating_sub(bytes);
        let seconds = (now - since).as_secs_f64().max(1e-3);
        Figures {
            down_kbit_s: came as f64 * 8e-3 / seconds,
            thin_waiting: progress.thin.map(|t| t.waiting),
            seconds: stayed.as_secs_f64(),
            hand,
            rtt_ms: link.rtt.map(Span::as_millis_f64),
            loss: link.loss_in(),
            delay_ms: progress.delay.as_millis_f64(),
            here: progress.here,
            topology_version: progress.topology_version,
            link_lost: progress.link_lost,
            part: progress.part,
        }
    }

    /// Fades the force first, then stops all threads, then collects the summary.
    pub(crate) fn finish(mut self, ending: Ending) -> Result<Summary, ClientError> {
        self.status.close();
        let progress = self.parts.replica.progress();
        let mut summary = Summary {
            name: self.options.name.clone(),
            role: self.network.welcome.role.word().to_owned(),
            subscription: self.options.subscription.word().to_owned(),
            participant: self.network.welcome.participant.0,
            device: self.parts.device,
            reconnects: self.network.condition.borrow().returns,
            requests_lost: self.network.condition.borrow().requests_lost,
            compensation_ms: progress.delay.as_millis_f64(),
            clock_error_bound_ms: progress.clock_error.map(Span::as_millis_f64),
            realtime: "no force loop".to_owned(),
            ..Summary::default()
        };
        // Measured before the threads end, so that the shutdown does not count.
        summary.cpu = threads::cpu_time().usage_since(&self.cpu_began);
        let haptics = self.parts.haptics.map(HapticHandle::stop);
        if let Some(dropped) = self.parts.motion.map(MotionThread::stop) {
            summary.events.frames_dropped = dropped;
        }
        let solved = self.parts.replica.stop();
        let stats = self.network.leave();
        let stayed = (monotonic_now() - self.began).as_secs_f64().max(1e-3);
        summary.down_kbit_s = stats.path.received_bytes as f64 * 8e-3 / stayed;
        summary.rtt_ms = stats.link.rtt.map(Span::as_millis_f64);
        summary.loss = stats.link.loss_in();
        if let Some(haptics) = &haptics {
            summary.take_haptics(haptics);
        }
        let mut recording = None;
        if let Some(solved) = solved {
            summary.take_solved(&solved);
            recording = Some(solved.recording);
        }
        let outcome = conclude(ending, summary, haptics.as_ref());
        match (&self.options.record, recording) {
            (Some(path), Some(recording)) => {
                write_recording(path, recording, haptics.as_ref(), outcome)
            }
            _ => outcome,
        }
    }
}

impl Summary {
    fn take_haptics(&mut self, haptics: &LoopSummary) {
        let on_the_way = self.events.frames_dropped;
        self.take_loop(&haptics.stats);
        self.events.frames_dropped += on_the_way;
        self.realtime = match &haptics.scheduling {
            Scheduling::RealTime { priority } => format!("real-time priority {priority}"),
            Scheduling::Ordinary { .. } => {
                let explanation = haptics.scheduling.explanation();
                explanation.unwrap_or_else(|| "ordinary priority, as configured".to_owned())
            }
        };
    }

    fn take_solved(&mut self, solved: &ReplicaSummary) {
        self.topology_version = solved.topology_version;
        self.topology_hash.clone_from(&solved.topology_hash);
        self.operations = solved.counters.operations;
        self.cuts = solved.counters.cuts;
        self.cuts_refused = solved.counters.cuts_refused;
        self.views_skipped = solved.counters.views_skipped;
        self.corrected_nodes = solved.counters.corrected_nodes;
        self.drift_mm_max = solved.counters.drift_max_m * 1e3;
        self.resyncs = solved.counters.resyncs;
        self.demotions = solved.counters.demotions;
        self.haptic_solves = solved.haptic_solves;
        self.haptic_solve_ms = solved.haptic_solve_ms;
        self.nodes_waiting_max = solved.thin.map(|t| t.waiting_max);
        self.view_solves = solved.view_solves;
        self.view_ms = solved.view_ms;
        self.seconds = solved.seconds;
        self.nearest_mm = solved.nearest_mm;
    }
}

/// Writes the recording. An error of the run takes precedence over one of the file.
fn write_recording(
    path: &Path,
    mut recording: Recording,
    haptics: Option<&LoopSummary>,
    outcome: Result<Summary, ClientError>,
) -> Result<Summary, ClientError> {
    if let Some(haptics) = haptics {
        let point =
            |p: &TracePoint| HapticPoint::new(p.time.as_micros(), &p.pose, p.buttons, p.force);
        recording.haptic = haptics.trace.points().iter().map(point).collect();
        recording.dropped.haptic = haptics.trace.lost();
    }
    let written = Staged::write(path, |out| Ok(serde_json::to_writer(out, &recording)?))
        .and_then(Staged::put_in_place);
    match (outcome, written) {
        (Ok(summary), Err(source)) => Err(ClientError::Record {
            source,
            summary: Box::new(summary),
        }),
        (outcome, _) => outcome,
    }
}

//! Supervision of a running session until it is over, and the shutdown in order.

use std::path::Path;
use std::sync::atomic::Ordering;

use palpate_protocol::session::CloseReason;
use palpate_protocol::{ClientTime, Span};
use palpate_site::ConnectionStatus;
use palpate_tissue::file::Staged;
use palpate_transport::threads::{self, CpuTime, Scheduling};
use palpate_view::{OwnFigures, State};

use super::ending::{Ending, conclude};
use super::join::Threads;
use super::status::{Figures, Status};
use crate::network::{MotionThread, Network};
use crate::realtime::{HapticHandle, LoopSummary, monotonic_now, sleep_until};
use crate::recording::Recording;
use crate::replica::{Part, Progress};
use crate::{ClientError, JoinOptions, Summary};

/// Polling period of the main thread.
const POLL_PERIOD: Span = Span::from_millis(50);

/// A running session.
pub(super) struct Supervision<'a> {
    pub(super) options: &'a JoinOptions,
    pub(super) network: Network,
    pub(super) threads: Threads,
    pub(super) status: Status,
    /// State of the connection at the last poll.
    pub(super) connection: ConnectionStatus,
    pub(super) began: ClientTime,
    /// Whether this outage's lost cuts have been reported.
    pub(super) is_loss_told: bool,
    /// CPU time of the program at the start of the session.
    pub(super) cpu_began: CpuTime,
    /// Bytes received and time, as of the last status line.
    pub(super) received: (u64, ClientTime),
}

impl Supervision<'_> {
    pub(super) fn report_joined(&mut self) {
        let welcome = &self.network.session.welcome;
        let roster = welcome.roster.iter();
        let others = roster.filter(|entry| entry.participant != welcome.participant);
        let others = others.count();
        let sentence = format!(
            "joined as {} ({}), {others} others here, {} operations so far",
            self.options.name, welcome.role, welcome.operations_so_far
        );
        self.status.print(&sentence);
        let explanation = self
            .threads
            .haptics
            .as_ref()
            .and_then(|h| h.scheduling().explanation());
        if let Some(explanation) = explanation {
            self.status.print(&explanation);
        }
        if let Some(page) = &self.threads.page {
            let sentence = format!("the page is at {}", page.url());
            self.status.print(&sentence);
        }
    }

    /// Supervises all threads until the session is over.
    pub(super) fn supervise(&mut self) -> Ending {
        loop {
            let now = monotonic_now();
            let mut progress = self.threads.replica.progress();
            if let Some(haptics) = &self.threads.haptics {
                // No force of a replica that differs from the server's is rendered.
                haptics.set_link_lost(progress.link_lost || progress.part == Part::Resyncing);
                if !haptics.is_running() {
                    return Ending::Panicked("force loop");
                }
            }
            for sentence in &progress.notices {
                self.status.print(sentence);
                if let Some(page) = &self.threads.page {
                    page.notice(sentence);
                }
            }
            if self.network.is_broken() {
                return Ending::Panicked("network");
            }
            if let Some(ending) = progress.ending.take() {
                return ending;
            }
            if !self.threads.replica.is_running() {
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
                if let Some(why) = &self.connection.lost {
                    return Ending::Closed(CloseReason::ConnectionLost(why.clone()));
                }
                let sentence = format!("you left after {} s, as asked", duration.as_secs_f64());
                return Ending::Wish(sentence);
            }
            let state = self.threads.page.as_mut().and_then(|page| page.poll(now));
            let is_status_due = self.status.is_due(now);
            if state.is_some() || is_status_due {
                let figures = self.figures(stayed, progress, is_status_due);
                if is_status_due {
                    self.status.show(&figures, now);
                }
                if let Some((page, state)) = self.threads.page.as_ref().zip(state) {
                    page.show(&self.measured(state, &figures));
                }
            }
            sleep_until(now + POLL_PERIOD);
        }
    }

    /// Reports a lost or restored connection.
    fn report_connection(&mut self) {
        let now = self.network.session.connection.borrow().clone();
        if now == self.connection {
            return;
        }
        if now.joined_again_as != self.connection.joined_again_as {
            self.status
                .print("the seat was gone; joined again as a new participant");
        } else if now.reconnects > self.connection.reconnects {
            self.status.print("reconnected, in the same seat");
        }
        if let Some(why) = now.lost.as_ref().filter(|_| self.connection.lost.is_none()) {
            self.status.print(&format!(
                "connection lost ({why}); no force; trying to reconnect for {} s",
                self.options.reconnect.as_secs_f64()
            ));
        }
        if let Some(retry) = now.retry.as_ref()
            && now.retry != self.connection.retry
        {
            self.status.print(&retry.to_string());
        }
        // A stroke has many parts.
        if now.requests_lost > self.connection.requests_lost && !self.is_loss_told {
            self.is_loss_told = true;
            self.status
                .print("your cut was lost with the connection; please repeat it");
        }
        self.is_loss_told &= now.lost.is_some();
        self.connection = now;
    }

    /// Figures now. The rate of reception counts from the last status line, which restarts the count.
    fn figures(&mut self, stayed: Span, replica: Progress, restarts: bool) -> Figures {
        let hand = self.threads.haptics.as_mut().map(HapticHandle::stats);
        let stats = *self.network.session.stats.borrow();
        let link = stats.link;
        let now = monotonic_now();
        let (bytes, since) = self.received;
        if restarts {
            self.received = (stats.path.received_bytes, now);
        }
        // A smaller count than before belongs to another connection.
        let received = stats.path.received_bytes.saturating_sub(bytes);
        let seconds = (now - since).as_secs_f64().max(1e-3);
        Figures {
            seconds: stayed.as_secs_f64(),
            hand,
            rtt_ms: link.rtt.map(Span::as_millis_f64),
            loss: link.loss_in(),
            down_kbit_s: received as f64 * 8e-3 / seconds,
            replica,
        }
    }

    /// The state of the session with the figures of this client.
    fn measured(&self, mut state: State, figures: &Figures) -> State {
        let cpu = threads::cpu_time().usage_since(&self.cpu_began).classes;
        state.session.delay_ms = figures.replica.delay.as_millis_f64();
        state.own = Some(OwnFigures {
            device: self.threads.device.clone(),
            loop_hz: figures.hand.map(|h| h.rate_hz),
            late_us_p99: figures.hand.map(|h| h.lateness_us.p99 as f64),
            model_age_ms: figures.replica.model_age.map(Span::as_millis_f64),
            force_n: figures.hand.map(|h| h.force_n),
            cpu,
            rtt_ms: figures.rtt_ms,
            loss: Some(figures.loss),
        });
        state
    }

    /// Fades the force first, then stops all threads, then collects the summary.
    pub(super) fn finish(mut self, ending: Ending) -> Result<Summary, ClientError> {
        self.status.close();
        let progress = self.threads.replica.progress();
        let connection = self.network.session.connection.borrow().clone();
        let welcome = &self.network.session.welcome;
        let mut summary = Summary {
            name: self.options.name.clone(),
            role: welcome.role.word().to_owned(),
            subscription: self.options.subscription.word().to_owned(),
            participant: connection.joined_again_as.unwrap_or(welcome.participant).0,
            device: self.threads.device,
            reconnects: connection.reconnects,
            requests_lost: connection.requests_lost,
            compensation_ms: progress.delay.as_millis_f64(),
            clock_error_bound_ms: progress.clock_error.map(Span::as_millis_f64),
            realtime: "no force loop".to_owned(),
            ..Summary::default()
        };
        // Measured before the threads end, so that the shutdown does not count.
        summary.cpu = threads::cpu_time().usage_since(&self.cpu_began);
        let haptics = self.threads.haptics.map(HapticHandle::stop);
        if let Some(dropped) = self.threads.motion.map(MotionThread::stop) {
            summary.events.frames_dropped = dropped;
        }
        let recording = self.threads.replica.stop(&mut summary);
        let stats = self.network.leave();
        let stayed = (monotonic_now() - self.began).as_secs_f64().max(1e-3);
        summary.down_kbit_s = stats.path.received_bytes as f64 * 8e-3 / stayed;
        summary.rtt_ms = stats.link.rtt.map(Span::as_millis_f64);
        summary.loss = stats.link.loss_in();
        if let Some(haptics) = &haptics {
            summary.take_haptics(haptics);
        }
        let ending = match ending {
            Ending::Closed(CloseReason::ConnectionLost(why)) if connection.is_seat_gone => {
                Ending::SeatGone(why)
            }
            other => other,
        };
        let outcome = conclude(ending, summary, haptics.as_ref());
        // After the force loop: a pointer without its page is unplugged to the loop.
        if let Some(page) = self.threads.page {
            match &outcome {
                Ok(summary) => page.close(&summary.ended),
                Err(error) => page.close(&error.to_string()),
            }
        }
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
}

/// Writes the recording. An error of the run takes precedence over one of the file.
fn write_recording(
    path: &Path,
    mut recording: Recording,
    haptics: Option<&LoopSummary>,
    outcome: Result<Summary, ClientError>,
) -> Result<Summary, ClientError> {
    if let Some(haptics) = haptics {
        recording.haptic = haptics.trace.points().to_vec();
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

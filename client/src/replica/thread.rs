//! The replica thread: runs a [`Site`] in real time.
//!
//! Every 4 ms it takes session events and hand samples, applies due operations, solves the haptic shape, and
//! publishes the results. Two helper threads prepare cuts and solve the view. Operations and prepared cuts wake it in between.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::JoinHandle;

use hdrhistogram::Histogram;
use palpate_device::backend::sim::ScriptStart;
use palpate_haptics::ContactModel;
use palpate_protocol::request::RequestKind;
use palpate_protocol::session::ClientEvent;
use palpate_protocol::{ClientTime, LocalSample, Span};
use palpate_site::{HAPTIC_PERIOD, Reach, Site, SiteError, ThinView, ViewUpdate, hand_budget};
use palpate_transport::ClientCommand;
use palpate_transport::threads::{self, ThreadClass};
use tokio::sync::mpsc;
use triple_buffer::{Input, Output};

use super::cut_worker::CutWorker;
use super::progress::{Part, Progress};
use super::view_thread::{Order, ViewReport, ViewThread};
use crate::network::Inbox;
use crate::page::PageWindow;
use crate::program::Ending;
use crate::realtime::{
    Frame, Horizon, device_time, monotonic_now, park_until, single_thread_pool, sleep_until, worked,
};
use crate::recording::{Recording, VIEW_HZ, ViewRecord};
use crate::{SolveTimes, StartAt, Summary};

/// Maximum period of a client without a hand, which only starts views.
const VIEW_POLL_PERIOD_MAX: Span = Span::from_millis(8);

/// Upper bound of the solve time histogram, µs.
const SOLVE_MAX_US: u64 = 1_000_000;

/// Inputs of the thread.
pub(crate) struct Inputs {
    pub(crate) site: Site,
    pub(crate) inbox: Arc<Inbox>,
    pub(crate) commands: mpsc::Sender<ClientCommand>,
    /// Requests a resync, with the reason.
    pub(crate) resync: mpsc::Sender<String>,
    /// `None` for spectators.
    pub(crate) hand: Option<Hand>,
    /// Start signal of the simulated hand's script, and the requested start.
    pub(crate) script: Option<(ScriptStart, StartAt)>,
    /// Recorded until the first contact of the tool.
    pub(crate) reach: Option<Reach>,
    /// Every n-th grid point is recorded; `None` records nothing.
    pub(crate) record_every: Option<i64>,
    pub(crate) recording: Recording,
    /// The page that shows this replica.
    pub(crate) page: Option<PageWindow>,
}

/// The ends of the force loop's buffers that belong to the replica.
pub(crate) struct Hand {
    pub(crate) models: Input<ContactModel>,
    pub(crate) newest: Output<Frame>,
    pub(crate) own: rtrb::Consumer<LocalSample>,
}

/// The running thread.
pub(crate) struct ReplicaThread {
    stop: Arc<AtomicBool>,
    progress: Arc<Mutex<Progress>>,
    thread: JoinHandle<ReplicaLoop>,
}

impl ReplicaThread {
    pub(crate) fn spawn(inputs: Inputs) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let mut replica = ReplicaLoop::new(inputs);
        let progress = Arc::clone(&replica.progress);
        let stopped = Arc::clone(&stop);
        // A spectator has no force, so a late solve does no harm.
        let class = if replica.inputs.hand.is_some() {
            ThreadClass::HandSolver
        } else {
            ThreadClass::Background
        };
        let thread = threads::spawn(class, "replica", move || {
            let _pool = single_thread_pool();
            replica.run(&stopped, class);
            replica
        })?;
        Ok(Self {
            stop,
            progress,
            thread,
        })
    }

    /// The current state; takes the notices.
    pub(crate) fn progress(&self) -> Progress {
        let mut progress = lock(&self.progress);
        let now = progress.clone();
        progress.notices.clear();
        now
    }

    /// Whether the thread runs; it ends early only by a panic.
    pub(crate) fn is_running(&self) -> bool {
        !self.thread.is_finished()
    }

    /// Stops the thread and adds its results to the summary. Returns the recording; `None` if the thread panicked.
    pub(crate) fn stop(self, summary: &mut Summary) -> Option<Recording> {
        self.stop.store(true, Ordering::Release);
        let replica = self.thread.join().ok()?;
        Some(replica.finish(summary))
    }
}

fn lock(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    // Every statement leaves the fields consistent.
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

fn try_lock(progress: &Mutex<Progress>) -> Option<MutexGuard<'_, Progress>> {
    match progress.try_lock() {
        Ok(progress) => Some(progress),
        Err(TryLockError::Poisoned(progress)) => Some(progress.into_inner()),
        Err(TryLockError::WouldBlock) => None,
    }
}

fn histogram() -> Histogram<u32> {
    Histogram::new_with_bounds(1, SOLVE_MAX_US, 3).expect("1 to 10^6 in 3 digits is a valid range")
}

struct Helpers {
    cuts: CutWorker,
    view: ViewThread,
}

struct ReplicaLoop {
    inputs: Inputs,
    /// Helper threads, once the initial log is applied.
    helpers: Option<Helpers>,
    /// Whether the replica of the helpers was built since the last charge. The hand waits for it, so the thread does not rest for
    /// that.
    has_built: bool,
    /// Number of resyncs before the replica of the helpers.
    resyncs: u64,
    progress: Arc<Mutex<Progress>>,
    horizon: Horizon,
    haptic_us: Histogram<u32>,
    view_us: Histogram<u32>,
    first_view: Option<ClientTime>,
    recorded_nodes: usize,
    link_lost: bool,
    ending: Option<Ending>,
}

impl ReplicaLoop {
    fn new(inputs: Inputs) -> Self {
        Self {
            inputs,
            helpers: None,
            has_built: false,
            resyncs: 0,
            progress: Arc::default(),
            horizon: Horizon::default(),
            haptic_us: histogram(),
            view_us: histogram(),
            first_view: None,
            recorded_nodes: 0,
            link_lost: false,
            ending: None,
        }
    }

    fn run(&mut self, stop: &AtomicBool, class: ThreadClass) {
        self.inputs.inbox.read_here();
        let mut budget = class.budget();
        let mut deadline = monotonic_now();
        let mut charged = worked();
        let period = if self.inputs.hand.is_some() {
            HAPTIC_PERIOD
        } else {
            let half_a_tick = Span::from_micros(500_000 / self.inputs.site.tick_hz().max(1));
            half_a_tick.clamp(HAPTIC_PERIOD, VIEW_POLL_PERIOD_MAX)
        };
        while !stop.load(Ordering::Acquire) {
            if self.ending.is_none() {
                self.step();
            }
            self.publish();
            let (now, cpu) = (monotonic_now(), worked());
            let mut rest = budget.charge(now.as_micros(), cpu - charged);
            charged = cpu;
            if std::mem::take(&mut self.has_built) {
                (budget, rest) = (class.budget(), Span::ZERO);
                deadline = now;
            }
            // Missed periods after a long solve are skipped.
            deadline = (deadline + period).max(now + rest);
            self.rest_until(deadline);
        }
    }

    /// Sleeps until the deadline. Cuts that arrive or are ready are handled in between, also while the budget is spent; it is charged
    /// for them afterwards.
    fn rest_until(&mut self, deadline: ClientTime) {
        while self.ending.is_none() && park_until(deadline) {
            self.guarded(Self::handle_events);
            self.view();
            if self.has_built {
                return;
            }
        }
        sleep_until(deadline);
    }

    /// Ends the session if `part` fails. Returns whether it succeeded.
    fn guarded(&mut self, part: impl FnOnce(&mut Self) -> Result<(), SiteError>) -> bool {
        let result = part(self);
        if let Err(error) = &result {
            self.ending = Some(Ending::Diverged(error.to_string()));
        }
        result.is_ok()
    }

    fn step(&mut self) {
        if !self.guarded(Self::handle_events) {
            return;
        }
        self.handle_samples();
        // Before the solve, which takes milliseconds: other sites wait for the parts of a stroke.
        self.pass_requests();
        self.start_script();
        self.haptic();
        if !self.guarded(Self::order_cuts) {
            return;
        }
        self.view();
        self.pass_resync();
    }

    fn handle_events(&mut self) -> Result<(), SiteError> {
        for event in self.inputs.inbox.take() {
            match &event {
                ClientEvent::LinkLost => self.link_lost = true,
                ClientEvent::LinkRestored => self.link_lost = false,
                ClientEvent::Closed(reason) => self.ending = Some(Ending::Closed(reason.clone())),
                _ => {}
            }
            if let Some(page) = &self.inputs.page {
                page.note(&event, monotonic_now());
            }
            let is_snapshot = matches!(event, ClientEvent::Snapshot(_));
            self.inputs.site.handle_event(event, monotonic_now())?;
            if let Some(page) = self.inputs.page.as_ref().filter(|_| is_snapshot)
                && let Some(history) = self.inputs.site.replica().history()
            {
                page.note_strokes(history.stroke_numbers());
            }
            let resyncs = self.inputs.site.counters().resyncs;
            if resyncs != self.resyncs {
                // The helpers work on the old replica; their results are discarded.
                self.resyncs = resyncs;
                self.helpers = None;
            }
        }
        self.poll_helpers()?;
        self.inputs.site.advance(monotonic_now())?;
        self.order_cuts()
    }

    /// Passes the site's orders to the cut worker.
    fn order_cuts(&mut self) -> Result<(), SiteError> {
        let (site, Some(helpers)) = (&mut self.inputs.site, &self.helpers) else {
            return Ok(());
        };
        while let Some(order) = site.poll_cut_order() {
            if let Err(error) = helpers.cuts.order(order) {
                self.helpers = None;
                return site.handle_broken(error, monotonic_now());
            }
        }
        Ok(())
    }

    /// Passes a resync request to the network thread.
    fn pass_resync(&mut self) {
        if let Some(why) = self.inputs.site.poll_resync() {
            // The channel holds one request; if the receiver has gone, the session is ending.
            let _ = self.inputs.resync.try_send(why);
        }
    }

    /// Exchanges orders and results with the helpers.
    fn poll_helpers(&mut self) -> Result<(), SiteError> {
        let site = &mut self.inputs.site;
        if let Some((prefetch, view)) = site.detach() {
            let failed = |error: std::io::Error| SiteError::Thread(error.to_string());
            let feed = self.inputs.page.as_ref().map(PageWindow::feed);
            self.has_built = true;
            self.helpers = Some(Helpers {
                cuts: CutWorker::spawn(prefetch).map_err(failed)?,
                view: ViewThread::spawn(view, feed).map_err(failed)?,
            });
        }
        let Some(helpers) = &mut self.helpers else {
            return Ok(());
        };
        loop {
            match helpers.cuts.poll() {
                Ok(Some(news)) => site.handle_cut(news),
                Ok(None) => break,
                Err(error) => {
                    // The worker has stopped.
                    self.helpers = None;
                    return site.handle_broken(error, monotonic_now());
                }
            }
        }
        let ended = |_| SiteError::Thread("the view thread has stopped".to_owned());
        while let Some(report) = helpers.view.poll().map_err(ended)? {
            match report {
                ViewReport::Compared(s, drift) => site.handle_drift(s, drift, monotonic_now()),
                ViewReport::Shown {
                    began,
                    took,
                    record,
                } => {
                    self.view_us
                        .saturating_record(took.as_micros().max(0) as u64);
                    self.first_view.get_or_insert(began);
                    if let Some(record) = record {
                        let nodes = &mut self.recorded_nodes;
                        self.inputs.recording.push_view(*record, nodes);
                    }
                }
            }
        }
        Ok(())
    }

    fn handle_samples(&mut self) {
        let Some(hand) = &mut self.inputs.hand else {
            return;
        };
        while let Ok(sample) = hand.own.pop() {
            self.inputs.site.handle_own(&sample);
            if let Some(reach) = &mut self.inputs.reach {
                reach.note(&sample);
            }
        }
    }

    /// Starts the script. Before its start the time follows the clock estimate; afterwards it is fixed.
    fn start_script(&mut self) {
        let Some((script, start)) = &self.inputs.script else {
            return;
        };
        let now = monotonic_now();
        if script.get().is_some_and(|t| t <= device_time(now)) {
            return;
        }
        let at = match start {
            StartAt::Session => self.inputs.site.script_start(),
            // The initial log must be applied, and the clock offset known to stamp samples.
            StartAt::Joining => {
                (self.helpers.is_some() && self.inputs.site.clock().is_some()).then_some(now)
            }
        };
        if let Some(at) = at {
            script.set(device_time(at));
            self.inputs.recording.script_started_us = Some(at.as_micros());
        }
    }

    fn haptic(&mut self) {
        let Some(hand) = &mut self.inputs.hand else {
            return;
        };
        let frame = *hand.newest.read();
        if !frame.is_measured {
            // A tool at the origin could touch the tissue there.
            return;
        }
        let (began, at_first) = (monotonic_now(), worked());
        let mut stop = || worked() - at_first > HAPTIC_PERIOD;
        let budget = hand_budget(&mut stop);
        let buttons = frame.tool_buttons();
        let pose = self.horizon.hand_pose(&frame);
        let is_trusted = !self.link_lost && !self.inputs.site.is_resyncing();
        let solves = self.inputs.site.counters().haptic_solves;
        if let Some(mut model) = self.inputs.site.haptic_step(began, pose, buttons, budget) {
            if model.touching().next().is_some() {
                self.inputs.reach = None;
            }
            if !is_trusted {
                remove_force(&mut model);
            }
            hand.models.write(model);
            if self.inputs.site.counters().haptic_solves > solves {
                self.horizon.note_model(frame.time, monotonic_now());
                record_time(&mut self.haptic_us, began);
            } else {
                self.horizon.note_pause();
            }
        }
    }

    /// Orders the newest view, unless the last one is still in progress.
    fn view(&mut self) {
        if self.inputs.site.is_thin() {
            return self.thin_view();
        }
        let Some(helpers) = &mut self.helpers else {
            return;
        };
        while let Some(news) = self.inputs.site.poll_view_update() {
            helpers.view.order(match news {
                ViewUpdate::Cut(cut) => Order::Cut(cut),
                ViewUpdate::Corrections(corrections) => Order::Correct(corrections),
            });
        }
        if helpers.view.is_busy() {
            return;
        }
        if let Some(frame) = self.inputs.site.next_view(monotonic_now()) {
            let every = self.inputs.record_every;
            let is_recorded = every.is_some_and(|n| frame.k % n == 0);
            if let Some(page) = &self.inputs.page {
                let hand = self.inputs.hand.as_mut().map(|hand| hand.newest.read());
                page.show_tools(&frame, hand.filter(|hand| hand.is_measured));
            }
            helpers.view.order(Order::Show(frame, is_recorded));
        }
    }

    /// Shows the received surface; there is nothing to solve.
    fn thin_view(&mut self) {
        let Some(frame) = self.inputs.site.next_view(monotonic_now()) else {
            return;
        };
        self.first_view.get_or_insert_with(monotonic_now);
        if let Some(page) = &mut self.inputs.page
            && let Some(thin) = self.inputs.site.replica().thin_view()
        {
            page.show_thin(self.inputs.site.replica().topology(), thin.shape(), &frame);
        }
        let every = self.inputs.record_every;
        if every.is_some_and(|n| frame.k % n == 0)
            && let Some((shape, version)) = self.inputs.site.seen()
        {
            let record = ViewRecord::new(&frame, shape, version, monotonic_now());
            let nodes = &mut self.recorded_nodes;
            self.inputs.recording.push_view(record, nodes);
        }
    }

    /// Sends requests to the session and applied operations to the recording.
    fn pass_requests(&mut self) {
        while let Some(request) = self.inputs.site.poll_request() {
            let is_cut = matches!(request, RequestKind::Cut(_));
            if is_cut {
                self.inputs.reach = None;
            }
            let sent = self
                .inputs
                .commands
                .try_send(ClientCommand::Request(request))
                .is_ok();
            if is_cut && !sent {
                lock(&self.progress)
                    .note("your cut could not be sent; please repeat it".to_owned());
            }
        }
        while let Some(operation) = self.inputs.site.poll_applied() {
            if self.inputs.record_every.is_some() {
                self.inputs.recording.push_operation(operation);
            }
        }
    }

    fn publish(&mut self) {
        // The main thread has ordinary priority and may be preempted with the lock held: the next step publishes.
        let Some(mut progress) = try_lock(&self.progress) else {
            return;
        };
        let site = &mut self.inputs.site;
        let delay = site
            .common_time(monotonic_now())
            .map_or(Span::ZERO, |(_, d)| d);
        progress.delay = delay;
        progress.clock_error = site.clock().map(|c| c.error_bound());
        progress.topology_version = site.replica().topology().version();
        let hand = self.inputs.hand.as_mut();
        progress.model_age = hand.map(|hand| hand.newest.read().contact_age);
        progress.here = site.roster().count();
        progress.link_lost = self.link_lost;
        progress.part = Part::of(site);
        progress.thin = site.replica().thin_view().map(ThinView::counters);
        while let Some(sentence) = site.poll_notice() {
            progress.note(sentence);
        }
        progress.ending.clone_from(&self.ending);
    }

    /// Adds the results to the summary and returns the recording.
    fn finish(self, summary: &mut Summary) -> Recording {
        let Inputs {
            site,
            reach,
            recording,
            ..
        } = self.inputs;
        let (topology, counters) = (site.replica().topology(), site.counters());
        let since = |first: ClientTime| (monotonic_now() - first).as_secs_f64();
        summary.topology_version = topology.version();
        summary.topology_hash = topology.hash().to_string();
        summary.operations = counters.operations;
        summary.cuts = counters.cuts;
        summary.cuts_refused = counters.cuts_refused;
        summary.views_skipped = counters.views_skipped;
        summary.corrected_nodes = counters.corrected_nodes;
        summary.drift_mm_max = counters.drift_max_m * 1e3;
        summary.resyncs = counters.resyncs;
        summary.demotions = counters.demotions;
        summary.nodes_waiting_max = site.replica().thin_view().map(|t| t.counters().waiting_max);
        summary.haptic_solves = self.haptic_us.len();
        summary.haptic_solve_ms = percentiles(&self.haptic_us);
        summary.view_solves = self.view_us.len();
        summary.view_ms = percentiles(&self.view_us);
        summary.seconds = self.first_view.map_or(0.0, since);
        summary.nearest_mm = reach.and_then(|r| r.nearest_mm(topology));
        recording
    }
}

/// Removes the force of a replica under resync, or without contact to the server. The main thread also informs the
/// force loop, but it may block on output.
fn remove_force(model: &mut ContactModel) {
    *model = ContactModel {
        is_inserted: model.is_inserted,
        external_work_j: model.external_work_j,
        ..ContactModel::absent_at(model.solved_at, model.topology_version)
    };
}

/// Every n-th grid point of rate `tick_hz` is recorded.
pub(crate) fn record_every(tick_hz: u32) -> i64 {
    i64::from(tick_hz.div_ceil(VIEW_HZ).max(1))
}

fn record_time(histogram: &mut Histogram<u32>, began: ClientTime) {
    let us = (monotonic_now() - began).as_micros().max(0) as u64;
    histogram.saturating_record(us);
}

fn percentiles(us: &Histogram<u32>) -> SolveTimes {
    let ms = |q| us.value_at_quantile(q) as f64 * 1e-3;
    SolveTimes {
        p50: ms(0.5),
        p99: ms(0.99),
    }
}

#[cfg(test)]
mod tests;

//! The thread: it waits for a deadline, runs one tick of the [`HandLoop`], and publishes the results.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;

use palpate_device::HapticDevice;
use palpate_haptics::{Chain, ContactModel};
use palpate_protocol::{ClientTime, Span};
use palpate_transport::threads::{self, Scheduling, ThreadClass};
use triple_buffer::{Input, Output, triple_buffer};

use super::clock;
use super::hand_loop::{Frame, HandLoop, LoopCommands, Turned};
use super::handle::{HapticHandle, LoopSummary};
use super::pace::Pace;
use super::stats::{LoopStats, Meter};
use super::trace::Trace;
use crate::recording::HapticPoint;

/// Publishing period of the statistics.
const STATS_EVERY: Span = Span::from_millis(250);

/// Frames in the ring to the network: a quarter of a second. If the network task stalls longer, the newest are dropped
/// and counted.
const RING_FRAMES: usize = 256;

/// Configuration of the thread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RealtimeConfig {
    /// Tick period; equal to the chain's.
    pub period: Span,
    /// Whether the thread requests the real-time priority of its class.
    pub real_time: bool,
    /// Every n-th tick is recorded in the trace; 0 records none.
    pub trace_every: u32,
    /// Capacity of the trace: 30,000 points are 120 s of every fourth tick, or 1.9 MB.
    pub trace_points_max: usize,
}

impl Default for RealtimeConfig {
    fn default() -> Self {
        Self {
            period: Span::from_millis(1),
            real_time: true,
            trace_every: 4,
            trace_points_max: 30_000,
        }
    }
}

/// The ends of the thread's buffers, each for one thread.
pub struct HapticPorts {
    /// The solver writes the newest contact model here.
    pub models: Input<ContactModel>,
    /// The newest frame, for the solver.
    pub newest: Output<Frame>,
    /// Every frame with a good reading, for the network.
    pub frames: rtrb::Consumer<Frame>,
}

/// Shared flags from the handle to the thread.
pub(super) struct Control {
    pub(super) stop: AtomicBool,
    pub(super) link_lost: AtomicBool,
}

/// Starts the haptic thread, which enables the device's forces and closes the device at its end.
pub fn spawn(
    device: Box<dyn HapticDevice>,
    chain: Chain,
    config: RealtimeConfig,
) -> std::io::Result<(HapticHandle, HapticPorts)> {
    let now = clock::monotonic_now();
    let frame = Frame::before(now);
    let control = Arc::new(Control {
        stop: AtomicBool::new(false),
        link_lost: AtomicBool::new(false),
    });
    let (models_in, models_out) = triple_buffer(&ContactModel::absent_at(ClientTime::ZERO, 0));
    let (newest_in, newest_out) = triple_buffer(&frame);
    let (stats_in, stats_out) = triple_buffer(&LoopStats::default());
    let (ring_in, ring_out) = rtrb::RingBuffer::new(RING_FRAMES);
    let haptic_loop = HapticLoop {
        hand: HandLoop::new(device, chain, config.period, now),
        control: Arc::clone(&control),
        models: models_out,
        newest: newest_in,
        frames: ring_in,
        stats: stats_in,
        meter: Meter::new(now),
        trace: Trace::new(config.trace_every, config.trace_points_max),
    };
    let (sender, receiver) = mpsc::sync_channel(1);
    let thread = std::thread::Builder::new()
        .name("haptics".to_owned())
        .spawn(move || {
            let class = if config.real_time {
                ThreadClass::Force
            } else {
                ThreadClass::Background
            };
            let membership = threads::enter(class);
            let _ = sender.send(membership.scheduling().clone());
            haptic_loop.run(config.period, membership.scheduling().clone())
        })?;
    let scheduling = receiver.recv().unwrap_or(Scheduling::Ordinary {
        refused: Some("the haptic thread ended before its first tick".to_owned()),
    });
    let handle = HapticHandle::new(control, stats_out, thread, scheduling);
    let ports = HapticPorts {
        models: models_in,
        newest: newest_out,
        frames: ring_out,
    };
    Ok((handle, ports))
}

struct HapticLoop {
    hand: HandLoop,
    control: Arc<Control>,
    models: Output<ContactModel>,
    newest: Input<Frame>,
    frames: rtrb::Producer<Frame>,
    stats: Input<LoopStats>,
    meter: Meter,
    trace: Trace,
}

impl HapticLoop {
    fn run(mut self, period: Span, scheduling: Scheduling) -> LoopSummary {
        let began = clock::monotonic_now();
        self.meter = Meter::new(began);
        let mut pace = Pace::new(began, period);
        // Force must not persist after a panic of the loop or of a driver.
        let outcome = catch_unwind(AssertUnwindSafe(|| self.serve(&mut pace)));
        let closed = catch_unwind(AssertUnwindSafe(|| self.hand.close()));
        let panicked = outcome.and(closed).err().map(|p| message_of(p.as_ref()));
        let stats = self.meter.snapshot(clock::monotonic_now(), pace.missed());
        self.stats.write(stats);
        LoopSummary {
            stats,
            scheduling,
            trace: self.trace,
            panicked,
        }
    }

    /// Runs from enabling the forces until they have faded to zero.
    fn serve(&mut self, pace: &mut Pace) {
        self.hand.begin();
        let mut publish_at = pace.deadline() + STATS_EVERY;
        loop {
            let deadline = pace.deadline();
            clock::sleep_until(deadline);
            let woke = clock::monotonic_now();
            let turned = self
                .hand
                .turn(woke, self.loop_commands(), self.models.read());
            self.publish(&turned);
            let done = clock::monotonic_now();
            self.meter.record(deadline, woke);
            pace.done(done);
            // A clock that is set back must not delay the status line.
            if done >= publish_at || publish_at - done > STATS_EVERY {
                publish_at = done + STATS_EVERY;
                let stats = self.meter.snapshot(done, pace.missed());
                self.stats.write(stats);
            }
            if turned.is_over {
                return;
            }
        }
    }

    /// The current commands of the handle.
    fn loop_commands(&self) -> LoopCommands {
        LoopCommands {
            link_lost: self.control.link_lost.load(Ordering::Acquire),
            stop: self.control.stop.load(Ordering::Acquire),
        }
    }

    fn publish(&mut self, turned: &Turned) {
        let frame = turned.frame;
        self.newest.write(frame);
        if turned.is_good && self.frames.push(frame).is_err() {
            self.meter.stats.frames_dropped += 1;
        }
        let sample = &frame.sample;
        let (t_us, force) = (frame.time.as_micros(), frame.wrench.force);
        let point = HapticPoint::new(t_us, &sample.pose, sample.buttons, force);
        self.trace.record(point);
        self.meter.stats.force_n = frame.wrench.force.norm();
        self.meter.stats.counters = *self.hand.chain().counters();
        self.meter.stats.device = self.hand.counts();
    }
}

/// The message of a panic.
fn message_of(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("a panic without a message").to_owned()
}

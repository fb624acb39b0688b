//! The thread that solves what is seen, while the replica's serves the hand.

use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::JoinHandle;

use palpate_protocol::datagram::Corrections;
use palpate_protocol::{ClientTime, ServerTime, Span};
use palpate_tissue::{Budget, Shape};
use palpate_transport::threads::{self, ThreadClass};

use super::{Drift, VIEW_TOLERANCE, View, ViewCut};
use crate::realtime::{compute_alone, monotonic_now, worked};
use crate::recording::{ToolRecord, ViewRecord, choose_nodes};
use crate::site::ViewFrame;

/// Iterations of one view: as many as the server makes of the same moment.
const ITERATIONS: usize = 1;

/// Work on one view. Work and not time that passes: on a crowded machine a solve would otherwise be
/// given up before it began.
const WORK: Span = Span::from_millis(5);

/// What the thread is to do, in this order.
pub(crate) enum Order {
    /// Take a cut over.
    Cut(Box<ViewCut>),
    /// Compare with what the server says.
    Correct(Corrections),
    /// Solve this view; give its record if asked for.
    Show(ViewFrame, bool),
}

/// What came of it.
pub(crate) enum ViewReport {
    /// The view of this moment was so far from what the server says.
    Compared(ServerTime, Drift),
    /// A view was solved.
    Shown {
        began: ClientTime,
        took: Span,
        record: Option<Box<ViewRecord>>,
    },
}

/// A thread that solves views. It ends with this.
pub(crate) struct ViewThread {
    // Before the thread, so that it is gone when that is waited for.
    orders: Option<Sender<Order>>,
    reports: Receiver<ViewReport>,
    /// Views ordered and not yet shown.
    open: usize,
    thread: Option<JoinHandle<()>>,
}

impl ViewThread {
    pub(crate) fn spawn(view: View) -> std::io::Result<Self> {
        let (orders, told) = channel();
        let (tell, reports) = channel();
        let thread = threads::spawn(ThreadClass::Background, "view", move || {
            let _pool = compute_alone();
            serve(view, &told, &tell);
        })?;
        Ok(Self {
            orders: Some(orders),
            reports,
            open: 0,
            thread: Some(thread),
        })
    }

    /// Whether it is still at the last view.
    pub(crate) fn is_busy(&self) -> bool {
        self.open > 0
    }

    /// Has something done. Whether there is anybody to do it.
    pub(crate) fn order(&mut self, order: Order) -> bool {
        let shows = matches!(order, Order::Show(..));
        let told = self
            .orders
            .as_ref()
            .is_some_and(|orders| orders.send(order).is_ok());
        self.open += usize::from(shows && told);
        told
    }

    /// The next report, if there is one; an error when the thread has ended by itself.
    pub(crate) fn poll(&mut self) -> Result<Option<ViewReport>, ViewEnded> {
        match self.reports.try_recv() {
            Ok(report) => {
                if matches!(report, ViewReport::Shown { .. }) {
                    self.open -= 1;
                }
                Ok(Some(report))
            }
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(ViewEnded),
        }
    }
}

/// The thread has ended, by a panic.
#[derive(Debug)]
pub(crate) struct ViewEnded;

impl Drop for ViewThread {
    fn drop(&mut self) {
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            // A panic there has been told on standard error already.
            let _ = thread.join();
        }
    }
}

fn serve(mut view: View, told: &Receiver<Order>, tell: &Sender<ViewReport>) {
    for order in told {
        let report = match order {
            Order::Cut(cut) => {
                view.take(*cut);
                continue;
            }
            Order::Correct(corrections) => match view.correct(&corrections) {
                Some(drift) => ViewReport::Compared(corrections.view_time, drift),
                None => continue,
            },
            Order::Show(frame, is_recorded) => show(&mut view, &frame, is_recorded),
        };
        if tell.send(report).is_err() {
            return;
        }
    }
}

fn show(view: &mut View, frame: &ViewFrame, is_recorded: bool) -> ViewReport {
    let (began, at_first) = (monotonic_now(), worked());
    let mut stop = || worked() - at_first > WORK;
    let budget = Budget {
        near: false,
        iterations: ITERATIONS,
        tolerance: VIEW_TOLERANCE,
        stop: Some(&mut stop),
    };
    view.step(frame.s, &frame.tools, budget);
    let took = monotonic_now() - began;
    ViewReport::Shown {
        began,
        took,
        record: is_recorded.then(|| {
            let version = view.topology().version();
            Box::new(record(frame, view.shape(), version))
        }),
    }
}

/// What is shown of a moment, for a recording.
pub(crate) fn record(frame: &ViewFrame, shape: &Shape, topology_version: u32) -> ViewRecord {
    let moved = shape.displacement.iter().enumerate();
    ViewRecord {
        s_us: frame.s.as_micros(),
        shown_us: monotonic_now().as_micros(),
        delay_us: frame.delay.as_micros(),
        tools: frame
            .tools
            .iter()
            .map(|t| ToolRecord {
                participant: t.participant.0,
                position_m: t.position.into(),
                stale: t.stale,
            })
            .collect(),
        nodes: choose_nodes(moved.map(|(n, u)| (n as u32, (*u).into()))),
        topology_version,
    }
}

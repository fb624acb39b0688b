//! The thread that solves the view, while the replica's thread serves the hand.

use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::JoinHandle;

use palpate_protocol::datagram::Corrections;
use palpate_protocol::{ClientTime, ServerTime, Span};
use palpate_site::{Drift, VIEW_ITERATIONS, VIEW_TOLERANCE, View, ViewFrame};
use palpate_tissue::{Budget, PreparedCut};
use palpate_transport::threads::{self, ThreadClass};
use palpate_view::Feed;

use crate::realtime::{monotonic_now, single_thread_pool, worked};
use crate::recording::ViewRecord;

/// CPU time limit of one view. With elapsed time a busy machine would end a solve before it began.
const WORK: Span = Span::from_millis(5);

/// Orders to the thread, in order.
pub(crate) enum Order {
    /// Adopt a cut.
    Cut(Box<PreparedCut>),
    /// Compare a past view with the server.
    Correct(Corrections),
    /// Solve this view; record it if true.
    Show(ViewFrame, bool),
}

/// Results of the thread.
pub(crate) enum ViewReport {
    /// Difference of the view at this time from the server.
    Compared(ServerTime, Drift),
    /// A view was solved.
    Shown {
        began: ClientTime,
        took: Span,
        record: Option<Box<ViewRecord>>,
    },
}

/// The view thread. Dropping this ends it.
pub(crate) struct ViewThread {
    // Declared before the thread, so that dropping closes the channel before the join.
    orders: Option<Sender<Order>>,
    reports: Receiver<ViewReport>,
    /// Ordered views that are not solved yet.
    open: usize,
    thread: Option<JoinHandle<()>>,
}

impl ViewThread {
    /// Solves views; `feed` shows them to pages.
    pub(crate) fn spawn(view: View, feed: Option<Feed>) -> std::io::Result<Self> {
        let (orders, received) = channel();
        let (sender, reports) = channel();
        let thread = threads::spawn(ThreadClass::Background, "view", move || {
            let _pool = single_thread_pool();
            serve(view, feed, &received, &sender);
        })?;
        Ok(Self {
            orders: Some(orders),
            reports,
            open: 0,
            thread: Some(thread),
        })
    }

    /// Whether an ordered view is still in progress.
    pub(crate) fn is_busy(&self) -> bool {
        self.open > 0
    }

    /// Sends an order. Returns whether the thread still runs.
    pub(crate) fn order(&mut self, order: Order) -> bool {
        let shows = matches!(order, Order::Show(..));
        let is_sent = self
            .orders
            .as_ref()
            .is_some_and(|orders| orders.send(order).is_ok());
        self.open += usize::from(shows && is_sent);
        is_sent
    }

    /// The next report, if any; an error if the thread has stopped.
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

/// The thread has panicked.
#[derive(Debug)]
pub(crate) struct ViewEnded;

impl Drop for ViewThread {
    fn drop(&mut self) {
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            // A panic has already been printed on standard error.
            let _ = thread.join();
        }
    }
}

fn serve(
    mut view: View,
    mut feed: Option<Feed>,
    orders: &Receiver<Order>,
    reports: &Sender<ViewReport>,
) {
    for order in orders {
        let report = match order {
            Order::Cut(cut) => {
                view.take(*cut);
                continue;
            }
            Order::Correct(corrections) => match view.correct(&corrections) {
                Some(drift) => ViewReport::Compared(corrections.view_time, drift),
                None => continue,
            },
            Order::Show(frame, is_recorded) => {
                let report = show(&mut view, &frame, is_recorded);
                if let Some(feed) = &mut feed {
                    let reactions = view.reactions(&frame.tools);
                    let at = (frame.s, frame.returns());
                    feed.show(view.topology(), view.shape(), at, &reactions);
                }
                report
            }
        };
        if reports.send(report).is_err() {
            return;
        }
    }
}

fn show(view: &mut View, frame: &ViewFrame, is_recorded: bool) -> ViewReport {
    let (began, at_first) = (monotonic_now(), worked());
    let mut stop = || worked() - at_first > WORK;
    let budget = Budget {
        near: false,
        iterations: VIEW_ITERATIONS,
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
            Box::new(ViewRecord::new(
                frame,
                view.shape(),
                version,
                monotonic_now(),
            ))
        }),
    }
}

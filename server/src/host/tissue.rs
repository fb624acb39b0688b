//! The threads of the authoritative tissue: one solves the ticks, one prepares cuts.
//!
//! The room's thread relays motion and waits for neither.

use std::num::NonZeroUsize;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_protocol::{Span, TopologyHash};
use palpate_room::{Authority, CutJob, Cutter, Settling, TissueOrder, TissueReport};
use palpate_tissue::{PreparedCut, Tissue};
use palpate_transport::threads::{self, ThreadClass};
use palpate_view::Feed;
use tokio::sync::mpsc as async_mpsc;

use crate::ServerError;

/// A report of the tissue with its cost.
pub(super) struct Answer {
    pub(super) report: TissueReport,
    /// Wall time of the order, without queueing.
    pub(super) took: Duration,
}

/// Commands for the thread that solves the ticks.
enum Work {
    Order(TissueOrder),
    Prepared(Box<PreparedCut>),
    End,
}

/// Work for the thread that prepares cuts.
enum CutWork {
    Cut(Box<CutJob>),
    Snapshot,
}

/// The two threads.
pub(super) struct TissueThreads {
    work: Sender<Work>,
    /// Bounded by the room, which allows one tick and a few cuts at a time.
    pub(super) answers: async_mpsc::UnboundedReceiver<Answer>,
    cuts: JoinHandle<Cutter>,
}

impl TissueThreads {
    /// `limit` is the CPU time of a tick after which no further iteration begins; `feed` shows each tick to pages. Returns
    /// the hash of the topology, too.
    pub(super) fn start(
        tissue: Tissue,
        limit: Duration,
        feed: Option<Feed>,
    ) -> Result<(Self, TopologyHash), ServerError> {
        let io = |source| ServerError::Io {
            doing: "the threads of the tissue could not be started".to_owned(),
            source,
        };
        let (authority, cutter) = Authority::of(tissue);
        let hash = cutter.hash();
        let (work, todo) = channel();
        let (jobs, jobs_todo) = channel();
        let (answer, answers) = async_mpsc::unbounded_channel();
        let settler = Settler {
            authority,
            limit_ns: i64::try_from(limit.as_nanos()).unwrap_or(i64::MAX),
            jobs,
            answer: answer.clone(),
            feed,
        };
        let solvers = pool("solver", ThreadClass::ServerTick)?;
        threads::spawn(ThreadClass::Background, "tissue", move || {
            solvers.install(move || settler.run(&todo));
        })
        .map_err(io)?;
        let prepared = work.clone();
        let cutters = pool("cutter", ThreadClass::Cut)?;
        let cuts = threads::spawn(ThreadClass::Background, "cuts", move || {
            cutters.install(move || cut_all(cutter, &jobs_todo, &prepared, &answer))
        })
        .map_err(io)?;
        let threads = Self {
            work,
            answers,
            cuts,
        };
        Ok((threads, hash))
    }

    /// Sends an order to its thread. Returns `false` if the thread has ended, which happens only after a panic.
    pub(super) fn order(&self, order: TissueOrder) -> bool {
        self.work.send(Work::Order(order)).is_ok()
    }

    /// Ends both threads. Returns the newest topology, with every cut of the log; `None` after a panic.
    pub(super) fn finish(self) -> Option<Cutter> {
        // Each thread holds a sender of the other's queue, so neither queue closes by itself.
        let _ = self.work.send(Work::End);
        self.cuts.join().ok()
    }
}

/// Threads of a class for the loops of the solver or of the cuts: half the processors, because other sessions share the
/// machine.
fn pool(name: &'static str, class: ThreadClass) -> Result<rayon::ThreadPool, ServerError> {
    let cores = std::thread::available_parallelism().map_or(1, NonZeroUsize::get);
    rayon::ThreadPoolBuilder::new()
        .num_threads((cores / 2).max(1))
        .thread_name(move |i| format!("{name}-{i}"))
        .start_handler(move |_| threads::join(class))
        .exit_handler(|_| threads::leave())
        .build()
        .map_err(|e| ServerError::Io {
            doing: "the solver threads could not be started".to_owned(),
            source: std::io::Error::other(e),
        })
}

struct Settler {
    authority: Authority,
    limit_ns: i64,
    jobs: Sender<CutWork>,
    answer: async_mpsc::UnboundedSender<Answer>,
    feed: Option<Feed>,
}

impl Settler {
    fn run(mut self, todo: &Receiver<Work>) {
        let mut budget = ThreadClass::ServerTick.budget();
        let (mut tick, mut free_ns) = (None, 0);
        while let Some(work) = next_work(todo, &mut tick, free_ns) {
            match work {
                Work::End => return,
                Work::Prepared(cut) => self.authority.take_cut(*cut),
                Work::Order(TissueOrder::Apply { version, at }) => {
                    self.authority.apply(version, at);
                }
                Work::Order(TissueOrder::Cut(order)) => {
                    // The cut thread lives while this one holds a sender of its queue.
                    let job = Box::new(self.authority.job(&order));
                    let _ = self.jobs.send(CutWork::Cut(job));
                }
                Work::Order(TissueOrder::Snapshot) => {
                    let _ = self.jobs.send(CutWork::Snapshot);
                }
                Work::Order(TissueOrder::Settle(order)) => {
                    let (began_ns, worked_ns) = (threads::monotonic_ns(), threads::worked_ns());
                    let mut stop = || threads::worked_ns() - worked_ns >= self.limit_ns;
                    let report = self.authority.settle(&order, &mut stop);
                    let now_ns = threads::monotonic_ns();
                    let took = Duration::from_nanos((now_ns - began_ns).unsigned_abs());
                    if self.answer.send(Answer { report, took }).is_err() {
                        return;
                    }
                    if let Some(feed) = &mut self.feed {
                        let tissue = self.authority.tissue();
                        let at = (order.view_time, order.returns);
                        let reactions = self.authority.reactions();
                        feed.show(tissue.topology(), tissue.shape(), at, &reactions);
                    }
                    let used = Span::from_micros((threads::worked_ns() - worked_ns) / 1000);
                    let rest = budget.charge(now_ns / 1000, used);
                    free_ns = now_ns + rest.as_micros() * 1000;
                }
            }
        }
    }
}

/// The next work; `None` when the queue has closed. A tick waits until `free_ns`, when the CPU budget allows one again, and
/// everything that arrives meanwhile comes before it: other sites wait for cuts.
fn next_work(todo: &Receiver<Work>, tick: &mut Option<Settling>, free_ns: i64) -> Option<Work> {
    if tick.is_none() {
        match todo.recv().ok()? {
            Work::Order(TissueOrder::Settle(settling)) => *tick = Some(settling),
            other => return Some(other),
        }
    }
    let rest_ns = (free_ns - threads::monotonic_ns()).max(0).unsigned_abs();
    match todo.recv_timeout(Duration::from_nanos(rest_ns)) {
        Ok(other) => Some(other),
        Err(RecvTimeoutError::Timeout) => tick.take().map(|t| Work::Order(TissueOrder::Settle(t))),
        Err(RecvTimeoutError::Disconnected) => None,
    }
}

/// Prepares cuts and takes snapshots until the queue closes. Returns the newest topology. Each cut is reported once its
/// topology is known, and again when it is prepared.
fn cut_all(
    mut cutter: Cutter,
    jobs: &Receiver<CutWork>,
    prepared: &Sender<Work>,
    answer: &async_mpsc::UnboundedSender<Answer>,
) -> Cutter {
    for job in jobs {
        let (began_ns, worked_ns) = (threads::monotonic_ns(), threads::worked_ns());
        let send = |report| {
            let took = Duration::from_nanos((threads::monotonic_ns() - began_ns).unsigned_abs());
            answer.send(Answer { report, took }).is_ok()
        };
        let is_sent = match job {
            CutWork::Snapshot => send(cutter.snapshot()),
            CutWork::Cut(job) => {
                let (report, cut) = cutter.make(&job);
                let is_sent = send(report);
                if let Some(cut) = cut {
                    let _ = prepared.send(Work::Prepared(Box::new(cut.finish())));
                }
                let took = Span::from_micros((threads::worked_ns() - worked_ns) / 1000);
                let author = job.author();
                is_sent && send(TissueReport::Prepared { author, took })
            }
        };
        if !is_sent {
            break;
        }
    }
    cutter
}

#[cfg(test)]
mod tests {
    use palpate_protocol::ServerTime;

    use super::*;

    #[test]
    fn tick_waits_for_its_budget_and_cuts_do_not() {
        let (work, todo) = channel();
        let settle = Settling {
            view_time: ServerTime::ZERO,
            tools: Vec::new(),
            blades: Vec::new(),
            returns: false,
            wants_corrections: false,
            wants_picture: None,
        };
        let free_ns = threads::monotonic_ns() + 1_000_000_000;
        work.send(Work::Order(TissueOrder::Settle(settle))).unwrap();
        let later = work.clone();
        let cut = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(5));
            later.send(Work::Order(TissueOrder::Snapshot)).unwrap();
        });
        let mut tick = None;
        let first = next_work(&todo, &mut tick, free_ns);
        assert!(matches!(first, Some(Work::Order(TissueOrder::Snapshot))));
        let second = next_work(&todo, &mut tick, free_ns);
        assert!(matches!(second, Some(Work::Order(TissueOrder::Settle(_)))));
        assert!(threads::monotonic_ns() >= free_ns);
        cut.join().unwrap();
        drop(work);
        assert!(next_work(&todo, &mut tick, free_ns).is_none());
    }
}

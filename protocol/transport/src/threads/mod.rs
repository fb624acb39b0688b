//! Scheduling of every thread of a program by class, in one table.
//!
//! ```text
//! class        thread                                    priority   CPU budget per period
//! force        1 kHz force loop                          base       0.5 of  1 ms
//! hand-solver  tissue under the own tool                 base - 1   2   of  4 ms
//! network      sockets, session machines, motion relay   base - 2   5   of 10 ms
//! cut          cuts of server and replica                base - 3   15  of 33 ms
//! server-tick  authoritative tissue                      base - 4   15  of 33 ms
//! background   views, model building, statistics         ordinary   none
//! ```
//!
//! The base is 80 under `SCHED_FIFO`, or the limit `RLIMIT_RTPRIO` of the user where that is lower. A
//! thread without permission keeps ordinary priority, never less, and asks for short time slices instead
//! (EEVDF, Linux 6.12 and later). A supervisor thread enforces the budgets: a real-time thread that has
//! spent its budget runs at ordinary priority until the budget is replenished ([`CpuBudget`]), so that
//! no faulty thread can stop the machine. The loops of solvers also charge their own budget and sleep;
//! they handle cuts meanwhile.
//!
//! The registry is one per process, as threads and their priorities are.

mod budget;
#[cfg(test)]
mod overload_tests;
#[cfg(all(feature = "realtimekit", target_os = "linux"))]
mod realtime_kit;
mod registry;
mod sys;
mod usage;

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use palpate_protocol::Span;
use tokio::runtime::{Builder, Runtime};

pub use budget::CpuBudget;
pub use usage::{CpuTime, CpuUsage};

/// Base priority where the system sets no lower limit: above ordinary threads, below the kernel's own timers.
const BASE_PRIORITY: i32 = 80;

/// Whether threads of this process ask for real-time priority.
static ASKS_FOR_REAL_TIME: AtomicBool = AtomicBool::new(true);

/// Threads that enter a class from now on keep ordinary priority.
pub fn without_real_time() {
    ASKS_FOR_REAL_TIME.store(false, Ordering::Relaxed);
}

/// The class of a thread, from the most to the least urgent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ThreadClass {
    /// The 1 kHz loop between device and contact model.
    Force,
    /// The solver of the tissue under the own tool, 250 Hz.
    HandSolver,
    /// Sockets, session machines and the relay of motion.
    Network,
    /// Cuts of the authoritative tissue and of a replica.
    Cut,
    /// The solver of the authoritative tissue.
    ServerTick,
    /// Views, model building, statistics.
    Background,
}

/// Real-time parameters of a class.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RealTime {
    /// How far below the base priority.
    pub below_base: i32,
    /// CPU time that a thread may use in every period.
    pub runtime: Span,
    /// Length of the period.
    pub period: Span,
}

impl ThreadClass {
    /// All classes, the most urgent first.
    pub const ALL: [Self; 6] = [
        Self::Force,
        Self::HandSolver,
        Self::Network,
        Self::Cut,
        Self::ServerTick,
        Self::Background,
    ];

    /// Its name in statistics.
    pub fn word(self) -> &'static str {
        match self {
            Self::Force => "force",
            Self::HandSolver => "hand-solver",
            Self::Network => "network",
            Self::Cut => "cut",
            Self::ServerTick => "server-tick",
            Self::Background => "background",
        }
    }

    /// Its real-time parameters; `None` for ordinary threads.
    pub fn real_time(self) -> Option<RealTime> {
        let class = |below_base, runtime_us, period_us| RealTime {
            below_base,
            runtime: Span::from_micros(runtime_us),
            period: Span::from_micros(period_us),
        };
        match self {
            Self::Force => Some(class(0, 500, 1_000)),
            Self::HandSolver => Some(class(1, 2_000, 4_000)),
            Self::Network => Some(class(2, 5_000, 10_000)),
            Self::Cut => Some(class(3, 15_000, 33_000)),
            Self::ServerTick => Some(class(4, 15_000, 33_000)),
            Self::Background => None,
        }
    }

    /// A fresh budget for a loop that charges it itself; without a limit for ordinary threads.
    pub fn budget(self) -> CpuBudget {
        match self.real_time() {
            Some(limit) => CpuBudget::new(limit.runtime, limit.period),
            None => CpuBudget::unlimited(),
        }
    }
}

/// The scheduling of a thread.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Scheduling {
    /// Before every ordinary thread.
    RealTime {
        /// The priority under `SCHED_FIFO`.
        priority: i32,
    },
    /// Ordinary priority, like every other thread of the user.
    Ordinary {
        /// Why real-time priority was refused; `None` where the class does not ask for it.
        refused: Option<String>,
    },
}

impl Scheduling {
    /// One sentence for the user where real-time priority was refused: cause, effect, remedy.
    pub fn explanation(&self) -> Option<String> {
        let Self::Ordinary { refused: Some(why) } = self else {
            return None;
        };
        Some(format!(
            "No real-time priority ({why}): forces may be late when the machine is busy. Allow it with `ulimit -r \
             {BASE_PRIORITY}` before starting (`rtprio` in /etc/security/limits.conf) or with `setcap cap_sys_nice=ep` \
             on the program."
        ))
    }
}

/// Starts a thread of a class.
pub fn spawn<T: Send + 'static>(
    class: ThreadClass,
    name: &str,
    body: impl FnOnce() -> T + Send + 'static,
) -> io::Result<JoinHandle<T>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(move || {
            let _membership = enter(class);
            body()
        })
}

/// Puts the calling thread into a class until the returned value is dropped.
pub fn enter(class: ThreadClass) -> Membership {
    sys::tighten_timers();
    let thread = sys::this_thread();
    let scheduling = schedule(thread, class);
    registry::add(thread, class, &scheduling);
    Membership { thread, scheduling }
}

/// The class of a thread, for as long as it lives.
#[derive(Debug)]
pub struct Membership {
    thread: sys::ThreadId,
    scheduling: Scheduling,
}

impl Membership {
    /// The scheduling of the thread.
    pub fn scheduling(&self) -> &Scheduling {
        &self.scheduling
    }
}

impl Drop for Membership {
    fn drop(&mut self) {
        registry::remove(self.thread);
        // Later work on this thread belongs to no class.
        let _ = sys::set_ordinary(self.thread);
    }
}

/// Hooks that put the worker threads of a tokio runtime into a class.
pub fn enter_workers(builder: &mut Builder, class: ThreadClass) {
    builder.on_thread_start(move || join(class));
    builder.on_thread_stop(leave);
}

/// A runtime with one thread at background priority, for pages, and for attackers and visitors in tests.
pub fn background_runtime() -> io::Result<Runtime> {
    let mut builder = Builder::new_multi_thread();
    enter_workers(&mut builder, ThreadClass::Background);
    builder.worker_threads(1).enable_all().build()
}

/// Puts the calling thread into a class until it calls [`leave`]: for the start hook of a thread pool.
pub fn join(class: ThreadClass) {
    std::mem::forget(enter(class));
}

/// Removes the calling thread from its class: for the exit hook of a thread pool.
pub fn leave() {
    registry::remove(sys::this_thread());
}

fn schedule(thread: sys::ThreadId, class: ThreadClass) -> Scheduling {
    let Some(real_time) = class.real_time() else {
        // Inherits nothing from the thread that started it.
        let _ = sys::set_background(thread);
        return Scheduling::Ordinary { refused: None };
    };
    if !ASKS_FOR_REAL_TIME.load(Ordering::Relaxed) {
        let _ = sys::set_ordinary(thread);
        return Scheduling::Ordinary {
            refused: Some("switched off by an option".to_owned()),
        };
    }
    match promote(thread, real_time.below_base) {
        Ok(priority) => Scheduling::RealTime { priority },
        Err(error) => {
            let _ = sys::set_ordinary(thread);
            Scheduling::Ordinary {
                refused: Some(error.to_string()),
            }
        }
    }
}

/// Asks for a real-time priority: the usual one, then the highest that the limit of the user allows.
fn promote(thread: sys::ThreadId, below_base: i32) -> io::Result<i32> {
    let usual = BASE_PRIORITY - below_base;
    let refusal = match sys::set_fifo(thread, usual) {
        Ok(()) => return Ok(usual),
        Err(error) => error,
    };
    let allowed = sys::priority_limit().min(BASE_PRIORITY) - below_base;
    if allowed > 0 && allowed < usual && sys::set_fifo(thread, allowed).is_ok() {
        return Ok(allowed);
    }
    #[cfg(all(feature = "realtimekit", target_os = "linux"))]
    if let Ok(priority) = realtime_kit::promote(thread, below_base) {
        return Ok(priority);
    }
    Err(refusal)
}

/// CPU time of this process so far, by class.
pub fn cpu_time() -> CpuTime {
    registry::cpu_time()
}

/// Nanoseconds on the machine's monotonic clock; on Unix its origin is shared by all processes.
pub fn monotonic_ns() -> i64 {
    sys::monotonic_ns()
}

/// CPU time of the calling thread in nanoseconds. Only differences mean anything.
pub fn worked_ns() -> i64 {
    sys::thread_cpu_ns(sys::this_thread()).unwrap_or_else(sys::monotonic_ns)
}

/// Sleeps until a moment of [`monotonic_ns`]; returns at once when it has passed.
pub fn sleep_until_ns(deadline_ns: i64) {
    sys::sleep_until_ns(deadline_ns);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_are_ordered_by_priority_and_every_budget_is_below_its_period() {
        let limits: Vec<RealTime> = (ThreadClass::ALL.iter())
            .filter_map(|c| c.real_time())
            .collect();
        assert!(limits.windows(2).all(|w| w[0].below_base < w[1].below_base));
        assert!(limits.iter().all(|l| l.runtime < l.period));
        assert_eq!(ThreadClass::Background.real_time(), None);
    }

    #[test]
    fn rejection_names_cause_effect_and_remedy() {
        let refused = Scheduling::Ordinary {
            refused: Some("Operation not permitted".to_owned()),
        };
        let sentence = refused.explanation().unwrap();
        for part in ["not permitted", "late", "ulimit -r", "cap_sys_nice"] {
            assert!(sentence.contains(part), "{sentence}");
        }
        let ordinary = Scheduling::Ordinary { refused: None };
        assert_eq!(ordinary.explanation(), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn no_class_is_ever_below_ordinary_priority() {
        for class in ThreadClass::ALL {
            let (nice, policy) = spawn(class, "test", sys::priority_of_this_thread)
                .unwrap()
                .join()
                .unwrap();
            assert!(nice <= 0, "{class:?} has nice {nice}");
            assert_ne!(policy, libc::SCHED_IDLE, "{class:?}");
        }
    }

    /// The fallback independent of the user's rights: the thread is put where a rejected request puts
    /// it.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_thread_without_permission_has_ordinary_priority() {
        let (nice, policy) = std::thread::spawn(|| {
            sys::set_ordinary(sys::this_thread()).unwrap();
            sys::priority_of_this_thread()
        })
        .join()
        .unwrap();
        assert_eq!((nice, policy), (0, libc::SCHED_OTHER));
    }

    #[test]
    fn cpu_time_counts_for_the_class_during_and_after_a_thread() {
        let before = cpu_time();
        let burn = || {
            let began = worked_ns();
            while worked_ns() - began < 20_000_000 {
                std::hint::spin_loop();
            }
        };
        spawn(ThreadClass::Background, "burner", burn)
            .unwrap()
            .join()
            .unwrap();
        let used = cpu_time().since(&before);
        assert!(used.seconds_of(ThreadClass::Background) >= 0.02);
    }
}

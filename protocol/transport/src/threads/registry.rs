//! The threads of this process that belong to a class, and the supervisor that enforces their budgets.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, Once, PoisonError};

use palpate_protocol::Span;

use super::sys::{self, ThreadId};
use super::{CpuBudget, CpuTime, Scheduling, ThreadClass};

/// The supervisor's period: the longest time that a runaway thread can occupy the processor.
const WATCH_PERIOD_NS: i64 = 10_000_000;

/// Budgets are enforced over this many of their periods: a loop that charges itself evens out within
/// them.
const ENFORCED_PERIODS: i64 = 10;

static REGISTRY: Mutex<Registry> = Mutex::new(Registry {
    threads: BTreeMap::new(),
    ended_ns: BTreeMap::new(),
});

static SUPERVISOR: Once = Once::new();

struct Registry {
    threads: BTreeMap<ThreadId, Thread>,
    /// CPU time of threads that have ended.
    ended_ns: BTreeMap<ThreadClass, i64>,
}

struct Thread {
    class: ThreadClass,
    /// CPU time before the thread joined its class.
    before_ns: i64,
    /// `None` for a thread without real-time priority.
    enforced: Option<Enforced>,
}

struct Enforced {
    priority: i32,
    budget: CpuBudget,
    charged_ns: i64,
    /// While it rests at ordinary priority: until when.
    rests_until_ns: Option<i64>,
}

fn registry() -> MutexGuard<'static, Registry> {
    // Every statement below leaves the maps whole.
    REGISTRY.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(super) fn add(thread: ThreadId, class: ThreadClass, scheduling: &Scheduling) {
    let before_ns = sys::thread_cpu_ns(thread).unwrap_or(0);
    let enforced = match (scheduling, class.real_time()) {
        (Scheduling::RealTime { priority }, Some(limit)) => Some(Enforced {
            priority: *priority,
            budget: CpuBudget::new(
                Span::from_micros(limit.runtime.as_micros() * ENFORCED_PERIODS),
                Span::from_micros(limit.period.as_micros() * ENFORCED_PERIODS),
            ),
            charged_ns: before_ns,
            rests_until_ns: None,
        }),
        _ => None,
    };
    let is_enforced = enforced.is_some();
    registry().threads.insert(
        thread,
        Thread {
            class,
            before_ns,
            enforced,
        },
    );
    if is_enforced {
        SUPERVISOR.call_once(|| {
            let started = std::thread::Builder::new()
                .name("supervisor".to_owned())
                .spawn(supervise);
            if let Err(error) = started {
                tracing::warn!(%error, "CPU budgets are not enforced: the supervisor thread did not start");
            }
        });
    }
}

pub(super) fn remove(thread: ThreadId) {
    let mut registry = registry();
    if let Some(gone) = registry.threads.remove(&thread) {
        let used = sys::thread_cpu_ns(thread).unwrap_or(gone.before_ns) - gone.before_ns;
        *registry.ended_ns.entry(gone.class).or_default() += used;
    }
}

pub(super) fn cpu_time() -> CpuTime {
    let registry = registry();
    let mut classes_ns = registry.ended_ns.clone();
    for (id, thread) in &registry.threads {
        let used = sys::thread_cpu_ns(*id).unwrap_or(thread.before_ns) - thread.before_ns;
        *classes_ns.entry(thread.class).or_default() += used;
    }
    CpuTime {
        at_ns: sys::monotonic_ns(),
        process_ns: sys::process_cpu_ns(),
        classes_ns,
    }
}

/// The supervisor's loop. It outranks every thread that it watches, and ends with the process.
fn supervise() {
    let _ = sys::set_fifo(sys::this_thread(), super::BASE_PRIORITY + 1);
    let mut deadline_ns = sys::monotonic_ns();
    loop {
        deadline_ns = (deadline_ns + WATCH_PERIOD_NS).max(sys::monotonic_ns());
        sys::sleep_until_ns(deadline_ns);
        let now_ns = sys::monotonic_ns();
        for (id, thread) in &mut registry().threads {
            if let Some(enforced) = &mut thread.enforced {
                enforced.look(*id, now_ns);
            }
        }
    }
}

impl Enforced {
    /// Charges the thread's CPU time, removes its priority when the budget is spent, and restores it
    /// later.
    fn look(&mut self, id: ThreadId, now_ns: i64) {
        let Some(cpu_ns) = sys::thread_cpu_ns(id) else {
            return;
        };
        if self.rests_until_ns.is_some_and(|until| now_ns >= until) {
            // CPU time at ordinary priority is not charged.
            self.charged_ns = cpu_ns;
            if sys::set_fifo(id, self.priority).is_ok() {
                self.rests_until_ns = None;
            }
        }
        if self.rests_until_ns.is_some() {
            return;
        }
        let used = Span::from_micros((cpu_ns - self.charged_ns) / 1000);
        self.charged_ns += used.as_micros() * 1000;
        let rest = self.budget.charge(now_ns / 1000, used);
        if rest > Span::ZERO && sys::set_ordinary(id).is_ok() {
            self.rests_until_ns = Some(now_ns + rest.as_micros() * 1000);
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::super::{enter, sys};
    use super::*;

    /// Needs the permission that it tests; without it there is nothing to enforce.
    #[test]
    fn busy_real_time_thread_loses_and_regains_its_priority() {
        let seen = std::thread::spawn(|| {
            let membership = enter(ThreadClass::Network);
            if !matches!(membership.scheduling(), Scheduling::RealTime { .. }) {
                return None;
            }
            let began = sys::monotonic_ns();
            let mut policies = Vec::new();
            while sys::monotonic_ns() - began < 2_000_000_000 && policies.len() < 3 {
                let (_, policy) = sys::priority_of_this_thread();
                if policies.last() != Some(&policy) {
                    policies.push(policy);
                }
            }
            Some(policies)
        })
        .join()
        .unwrap();
        if let Some(policies) = seen {
            let fifo = libc::SCHED_FIFO;
            assert_eq!(policies, [fifo, libc::SCHED_OTHER, fifo]);
        }
    }
}

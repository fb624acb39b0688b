//! System calls for clocks and scheduling, with all `unsafe` of this crate.
//!
//! On systems other than Linux scheduling is unchanged and the CPU time of threads is unknown.

use std::io;

#[cfg(target_os = "linux")]
pub(super) use linux::*;
#[cfg(not(target_os = "linux"))]
pub(super) use portable::*;

/// Nanoseconds on a clock of the system, which must exist: both callers name one that always does.
#[cfg(unix)]
fn clock_ns(clock: libc::clockid_t) -> Option<i64> {
    let mut t = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `t` is a valid timespec that lives across the call, which writes only to it.
    let result = unsafe { libc::clock_gettime(clock, &raw mut t) };
    #[allow(
        clippy::unnecessary_cast,
        reason = "32-bit systems have narrower fields"
    )]
    let (s, ns) = (t.tv_sec as i64, t.tv_nsec as i64);
    (result == 0).then_some(s * 1_000_000_000 + ns)
}

/// Nanoseconds on the machine's monotonic clock. On Unix its origin is shared by all processes of
/// the machine (on Linux the boot); elsewhere it is the first call of this process.
#[cfg(unix)]
pub(super) fn monotonic_ns() -> i64 {
    clock_ns(libc::CLOCK_MONOTONIC).unwrap_or(0)
}

/// Nanoseconds since the first call of this process.
#[cfg(not(unix))]
pub(super) fn monotonic_ns() -> i64 {
    static ORIGIN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    ORIGIN
        .get_or_init(std::time::Instant::now)
        .elapsed()
        .as_nanos() as i64
}

#[cfg(target_os = "linux")]
mod linux {
    use super::{clock_ns, io};

    /// The kernel's number of a thread.
    pub(in super::super) type ThreadId = libc::pid_t;

    /// Time slice of an ordinary thread that has to answer quickly, ns. Short slices run sooner under EEVDF; they
    /// do not run more.
    const SHORT_SLICE_NS: u64 = 500_000;

    pub(in super::super) fn this_thread() -> ThreadId {
        // SAFETY: the call takes no arguments and only returns a number.
        unsafe { libc::gettid() }
    }

    /// CPU time of a thread of this process; `None` when it has ended.
    pub(in super::super) fn thread_cpu_ns(thread: ThreadId) -> Option<i64> {
        // The kernel's encoding of the CPU clock of a thread (`CPUCLOCK_PERTHREAD | CPUCLOCK_SCHED`).
        clock_ns((!thread << 3) | 6)
    }

    pub(in super::super) fn process_cpu_ns() -> i64 {
        clock_ns(libc::CLOCK_PROCESS_CPUTIME_ID).unwrap_or(0)
    }

    /// Sleeps until `deadline_ns` on the clock of [`monotonic_ns`](super::monotonic_ns); returns at once when it has
    /// passed. The deadline is absolute, so a late wake-up delays no later one.
    pub(in super::super) fn sleep_until_ns(deadline_ns: i64) {
        let t = libc::timespec {
            tv_sec: deadline_ns.div_euclid(1_000_000_000) as libc::time_t,
            tv_nsec: deadline_ns.rem_euclid(1_000_000_000) as _,
        };
        loop {
            // SAFETY: `t` is a valid timespec that lives across the call, which only reads it; the null
            // pointer means that the remaining time is not requested.
            let result = unsafe {
                libc::clock_nanosleep(
                    libc::CLOCK_MONOTONIC,
                    libc::TIMER_ABSTIME,
                    &raw const t,
                    std::ptr::null_mut(),
                )
            };
            if result != libc::EINTR {
                return;
            }
        }
    }

    /// Lets timers of this thread fire within a microsecond instead of the usual 50. It matters only
    /// without `SCHED_FIFO`, and a refusal changes nothing else.
    pub(in super::super) fn tighten_timers() {
        const SLACK_NS: libc::c_ulong = 1000;
        // SAFETY: this option takes one integer and accesses no memory of this process.
        let _ = unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, SLACK_NS) };
    }

    /// Puts a thread under `SCHED_FIFO`. Threads that it starts do not inherit that.
    pub(in super::super) fn set_fifo(thread: ThreadId, priority: i32) -> io::Result<()> {
        set_policy(thread, libc::SCHED_FIFO, priority)
    }

    /// Gives a thread ordinary priority with a short time slice.
    pub(in super::super) fn set_ordinary(thread: ThreadId) -> io::Result<()> {
        set_policy(thread, libc::SCHED_OTHER, 0)?;
        shorten_slice(thread);
        Ok(())
    }

    /// Gives a thread ordinary priority; it does not preempt other threads when it wakes.
    pub(in super::super) fn set_background(thread: ThreadId) -> io::Result<()> {
        set_policy(thread, libc::SCHED_BATCH, 0)
    }

    fn set_policy(thread: ThreadId, policy: i32, priority: i32) -> io::Result<()> {
        // SAFETY: all zeros is a valid sched_param: it holds integers only.
        let mut parameters: libc::sched_param = unsafe { std::mem::zeroed() };
        parameters.sched_priority = priority;
        let policy = policy | libc::SCHED_RESET_ON_FORK;
        // SAFETY: `parameters` is valid and lives across the call, which only reads it. The system call is made
        // directly because musl refuses this function.
        let result = unsafe {
            libc::syscall(
                libc::SYS_sched_setscheduler,
                thread,
                policy,
                &raw const parameters,
            )
        };
        if result == 0 {
            Ok(())
        } else {
            Err(io::Error::last_os_error())
        }
    }

    /// The kernel's `struct sched_attr` in its first version.
    #[repr(C)]
    #[derive(Default)]
    struct SchedAttr {
        size: u32,
        policy: u32,
        flags: u64,
        nice: i32,
        priority: u32,
        runtime: u64,
        deadline: u64,
        period: u64,
    }

    /// Best effort: kernels before 6.12 ignore the slice.
    fn shorten_slice(thread: ThreadId) {
        const RESET_ON_FORK: u64 = 1;
        let attributes = SchedAttr {
            size: size_of::<SchedAttr>() as u32,
            policy: libc::SCHED_OTHER as u32,
            flags: RESET_ON_FORK,
            runtime: SHORT_SLICE_NS,
            ..SchedAttr::default()
        };
        // SAFETY: `attributes` has the layout of the kernel's structure, contains its size, and lives
        // across the call, which only reads it.
        let _ = unsafe {
            libc::syscall(
                libc::SYS_sched_setattr,
                thread,
                &raw const attributes,
                0_u32,
            )
        };
    }

    /// The highest real-time priority that an ordinary user may ask for; 0 for none.
    pub(in super::super) fn priority_limit() -> i32 {
        let mut limit = libc::rlimit {
            rlim_cur: 0,
            rlim_max: 0,
        };
        // SAFETY: `limit` is a valid rlimit that lives across the call, which writes only to it.
        let result = unsafe { libc::getrlimit(libc::RLIMIT_RTPRIO, &raw mut limit) };
        if result == 0 {
            i32::try_from(limit.rlim_cur.min(99)).unwrap_or(0)
        } else {
            0
        }
    }

    /// Bounds how long a real-time thread of this process may run without sleeping, as RealtimeKit demands.
    #[cfg(feature = "realtimekit")]
    pub(in super::super) fn limit_real_time(us: i64) -> io::Result<()> {
        let us = us.unsigned_abs();
        let limit = libc::rlimit {
            rlim_cur: us,
            rlim_max: us,
        };
        // SAFETY: `limit` is a valid rlimit that lives across the call, which only reads it.
        let result = unsafe { libc::setrlimit(libc::RLIMIT_RTTIME, &raw const limit) };
        if result == 0 {
            Ok(())
        } else {
            Err(io::Error::last_os_error())
        }
    }

    /// Nice value and policy of the calling thread.
    #[cfg(test)]
    pub(in super::super) fn priority_of_this_thread() -> (i32, i32) {
        // SAFETY: both calls take integers only; thread 0 is the calling one.
        let (nice, policy) = unsafe {
            (
                libc::getpriority(libc::PRIO_PROCESS, 0),
                libc::sched_getscheduler(0),
            )
        };
        (nice, policy & !libc::SCHED_RESET_ON_FORK)
    }
}

#[cfg(not(target_os = "linux"))]
mod portable {
    use std::hash::{DefaultHasher, Hash, Hasher};

    use super::io;

    pub(in super::super) type ThreadId = u64;

    pub(in super::super) fn this_thread() -> ThreadId {
        let mut hasher = DefaultHasher::new();
        std::thread::current().id().hash(&mut hasher);
        hasher.finish()
    }

    pub(in super::super) fn thread_cpu_ns(_thread: ThreadId) -> Option<i64> {
        None
    }

    pub(in super::super) fn process_cpu_ns() -> i64 {
        0
    }

    pub(in super::super) fn sleep_until_ns(deadline_ns: i64) {
        let left = deadline_ns - super::monotonic_ns();
        if left > 0 {
            std::thread::sleep(std::time::Duration::from_nanos(left as u64));
        }
    }

    pub(in super::super) fn tighten_timers() {}

    pub(in super::super) fn set_fifo(_thread: ThreadId, _priority: i32) -> io::Result<()> {
        Err(io::Error::from(io::ErrorKind::Unsupported))
    }

    pub(in super::super) fn set_ordinary(_thread: ThreadId) -> io::Result<()> {
        Ok(())
    }

    pub(in super::super) fn set_background(_thread: ThreadId) -> io::Result<()> {
        Ok(())
    }

    pub(in super::super) fn priority_limit() -> i32 {
        0
    }
}

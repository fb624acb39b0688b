//! The calls into the system, and the only `unsafe` of the client.

/// Nanoseconds on the machine's monotonic clock. On Unix its origin is shared by all processes of
/// the machine (on Linux the boot); elsewhere it is the first call of this process.
#[cfg(unix)]
pub(super) fn monotonic_ns() -> i64 {
    let mut t = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `t` is a valid timespec that lives across the call, which writes only to it.
    // CLOCK_MONOTONIC exists on every system with this call, so it can not fail.
    let _ = unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut t) };
    #[allow(
        clippy::unnecessary_cast,
        reason = "32-bit systems have narrower fields"
    )]
    let (s, ns) = (t.tv_sec as i64, t.tv_nsec as i64);
    s * 1_000_000_000 + ns
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

/// Nanoseconds for which this thread has had a processor.
#[cfg(target_os = "linux")]
pub(super) fn thread_ns() -> i64 {
    let mut t = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `t` is a valid timespec that lives across the call, which writes only to it. Linux has
    // had this clock since 2.6.12, so it can not fail.
    let _ = unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &raw mut t) };
    #[allow(
        clippy::unnecessary_cast,
        reason = "32-bit systems have narrower fields"
    )]
    let (s, ns) = (t.tv_sec as i64, t.tv_nsec as i64);
    s * 1_000_000_000 + ns
}

/// Elsewhere the time that has passed stands for it.
#[cfg(not(target_os = "linux"))]
pub(super) fn thread_ns() -> i64 {
    monotonic_ns()
}

/// Sleeps until `deadline_ns` on the clock of [`monotonic_ns`]; returns at once when it has
/// passed. The deadline is absolute, so a late wake-up delays no later one.
#[cfg(target_os = "linux")]
pub(super) fn sleep_until_ns(deadline_ns: i64) {
    let t = libc::timespec {
        tv_sec: deadline_ns.div_euclid(1_000_000_000) as libc::time_t,
        tv_nsec: deadline_ns.rem_euclid(1_000_000_000) as _,
    };
    loop {
        // SAFETY: `t` is a valid timespec that lives across the call, which only reads it; the
        // remaining time is not asked for, and a null pointer says so.
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

/// Sleeps until `deadline_ns`; returns at once when it has passed.
#[cfg(not(target_os = "linux"))]
pub(super) fn sleep_until_ns(deadline_ns: i64) {
    let left = deadline_ns - monotonic_ns();
    if left > 0 {
        std::thread::sleep(std::time::Duration::from_nanos(left as u64));
    }
}

/// Puts this thread under `SCHED_FIFO` with `priority`.
#[cfg(target_os = "linux")]
pub(super) fn set_fifo(priority: i32) -> Result<(), std::io::Error> {
    // SAFETY: all zeros is a valid sched_param: it holds integers only.
    let mut parameters: libc::sched_param = unsafe { std::mem::zeroed() };
    parameters.sched_priority = priority;
    // SAFETY: `parameters` is valid and lives across the call, which only reads it, and the handle
    // is that of the calling thread. (musl refuses `sched_setscheduler`; this call works there.)
    let result = unsafe {
        libc::pthread_setschedparam(
            libc::pthread_self(),
            libc::SCHED_FIFO,
            &raw const parameters,
        )
    };
    if result == 0 {
        Ok(())
    } else {
        Err(std::io::Error::from_raw_os_error(result))
    }
}

/// There is no such call here.
#[cfg(not(target_os = "linux"))]
pub(super) fn set_fifo(_priority: i32) -> Result<(), std::io::Error> {
    Err(std::io::Error::from(std::io::ErrorKind::Unsupported))
}

/// Lets timers of this thread fire within a microsecond instead of the usual 50. It matters only
/// without `SCHED_FIFO`, and a refusal changes nothing else.
#[cfg(target_os = "linux")]
pub(super) fn tighten_timers() {
    const SLACK_NS: libc::c_ulong = 1000;
    // SAFETY: this option takes one integer and touches no memory of ours.
    let _ = unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, SLACK_NS) };
}

/// There is no such call here.
#[cfg(not(target_os = "linux"))]
pub(super) fn tighten_timers() {}

/// Sets the nice value of this thread; whether the system let us.
#[cfg(target_os = "linux")]
pub(super) fn set_nice(nice: i32) -> bool {
    // SAFETY: the call takes integers only; on Linux process 0 is the calling thread.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, nice) == 0 }
}

/// Elsewhere a nice value belongs to the whole process, so it is left alone.
#[cfg(not(target_os = "linux"))]
pub(super) fn set_nice(_nice: i32) -> bool {
    false
}

//! The client's clock: the machine's monotonic clock, in microseconds.

use std::time::Duration;

use palpate_device::DeviceTime;
use palpate_protocol::{ClientTime, Span};
use palpate_transport::threads;

/// Current time of the machine's monotonic clock. On Linux it counts from boot, so that times of several clients on
/// one machine are comparable.
pub fn monotonic_now() -> ClientTime {
    ClientTime::from_micros(threads::monotonic_ns() / 1000)
}

/// CPU time of this thread. Only differences are meaningful.
pub fn worked() -> Span {
    Span::from_micros(threads::worked_ns() / 1000)
}

/// Sleeps until `deadline` on the clock of [`monotonic_now`]; returns at once if it has passed.
pub fn sleep_until(deadline: ClientTime) {
    threads::sleep_until_ns(deadline.as_micros().saturating_mul(1000));
}

/// Sleeps until `deadline` or until this thread is unparked. Returns whether the deadline is still ahead. Returns `false`
/// at once on Windows, which parks threads for up to 15 ms longer.
pub fn park_until(deadline: ClientTime) -> bool {
    if cfg!(windows) {
        return false;
    }
    let ahead = (deadline - monotonic_now()).as_micros();
    let Some(ahead) = u64::try_from(ahead).ok().filter(|us| *us > 0) else {
        return false;
    };
    std::thread::park_timeout(Duration::from_micros(ahead));
    monotonic_now() < deadline
}

/// A time of this clock for a device that runs on it.
pub fn device_time(now: ClientTime) -> DeviceTime {
    DeviceTime::from_micros(now.as_micros())
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;

    use super::{monotonic_now, park_until, sleep_until, worked};

    #[cfg(not(windows))]
    #[test]
    fn unparked_thread_returns_before_its_deadline() {
        std::thread::current().unpark();
        assert!(park_until(monotonic_now() + Span::from_millis(10_000)));
        let deadline = monotonic_now() + Span::from_micros(500);
        while park_until(deadline) {}
        assert!(monotonic_now() >= deadline);
        assert!(!park_until(deadline));
    }

    #[test]
    fn clock_is_monotonic_and_sleep_reaches_deadline() {
        let mut last = monotonic_now();
        for _ in 0..20 {
            let deadline = last + Span::from_micros(200);
            sleep_until(deadline);
            last = monotonic_now();
            assert!(last >= deadline);
        }
        sleep_until(last - Span::from_millis(1000));
    }

    #[test]
    fn sleeping_uses_no_cpu_time() {
        let (began, at) = (worked(), monotonic_now());
        sleep_until(at + Span::from_millis(30));
        assert!(
            worked() - began < Span::from_millis(15),
            "{:?}",
            worked() - began
        );
        let mut sum = 0_u64;
        while worked() - began < Span::from_millis(15) {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(monotonic_now() - at >= Span::from_millis(30));
    }
}

//! The client's clock: the machine's monotonic one, in microseconds.

use palpate_device::DeviceTime;
use palpate_protocol::{ClientTime, Span};
use palpate_transport::threads;

/// Now on the machine's monotonic clock. On Linux it counts from the boot and not from the start
/// of this process, so that times of several clients on one machine can be compared.
pub fn monotonic_now() -> ClientTime {
    ClientTime::from_micros(threads::monotonic_ns() / 1000)
}

/// Time that this thread has worked: unlike the time that has passed, it does not run while others
/// have the processor. Only differences mean anything.
pub fn worked() -> Span {
    Span::from_micros(threads::worked_ns() / 1000)
}

/// Sleeps until `deadline` on the clock of [`monotonic_now`]; not at all when it has passed.
pub fn sleep_until(deadline: ClientTime) {
    threads::sleep_until_ns(deadline.as_micros().saturating_mul(1000));
}

/// A moment of this clock as the device is given it: a device whose clock is ours runs on it.
pub fn device_time(now: ClientTime) -> DeviceTime {
    DeviceTime::from_micros(now.as_micros())
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;

    use super::{monotonic_now, sleep_until, worked};

    #[test]
    fn the_clock_does_not_run_backwards_and_sleep_reaches_its_deadline() {
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
    fn a_thread_that_sleeps_does_not_work() {
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

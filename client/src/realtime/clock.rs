//! The client's clock: the machine's monotonic one, in microseconds.

use palpate_device::DeviceTime;
use palpate_protocol::ClientTime;

use super::sys;

/// Now on the machine's monotonic clock. On Linux it counts from the boot and not from the start
/// of this process, so that times of several clients on one machine can be compared.
pub fn monotonic_now() -> ClientTime {
    ClientTime::from_micros(sys::monotonic_ns() / 1000)
}

/// Sleeps until `deadline` on the clock of [`monotonic_now`]; not at all when it has passed.
pub fn sleep_until(deadline: ClientTime) {
    sys::sleep_until_ns(deadline.as_micros().saturating_mul(1000));
}

/// A moment of this clock as the device is given it: a device whose clock is ours runs on it.
pub fn device_time(now: ClientTime) -> DeviceTime {
    DeviceTime::from_micros(now.as_micros())
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;

    use super::{monotonic_now, sleep_until};

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
}

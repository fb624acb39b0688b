//! The connection for states and forces, on its own thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::alarms::{AlarmMonitor, Alarms};
use super::inventory;
use super::link::{Link, Received};
use super::message::{Message, Spelling, force};
use crate::DeviceFault;
use crate::backend::mailbox::{DeviceState, DriverEnd, Order};

/// Wait for the loop's next force.
const IDLE: Duration = Duration::from_millis(2);

/// Wait for an answer. After it, zero force is sent without an answer.
const ANSWER: Duration = Duration::from_millis(50);

/// Maximum number of outstanding answers before the service counts as gone: half a second.
const OUTSTANDING_MAX: u32 = 10;

/// Time until a lost service is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(1);

/// The connection's thread.
pub(super) struct Session {
    pub(super) url: String,
    pub(super) id: String,
    pub(super) spelling: Spelling,
    pub(super) end: DriverEnd,
    pub(super) device_state: DeviceState,
    pub(super) alarms: Arc<Alarms>,
    pub(super) leave: Arc<AtomicBool>,
}

/// The connection has ended.
struct Ended;

impl Session {
    /// Runs until the stop flag is set, and reconnects after a loss. The last message is zero force.
    pub(super) fn run(mut self, link: Link) {
        let mut watch = AlarmMonitor::default();
        let mut next = Some(link);
        while let Some(mut link) = next.take() {
            link.wait_at_most(ANSWER);
            let ended = self.run_session(&mut link, &mut watch);
            // Also after a loss: a service that sends nothing may still receive.
            let _ = self.send(&mut link, &Order::OFF);
            if ended.is_ok() {
                link.receive();
                link.close();
                return;
            }
            link.close();
            self.end.cut();
            self.end.publish(DeviceState {
                lost: Some(DeviceFault::Unplugged),
                ..self.device_state
            });
            next = self.reconnect();
            // Orders from before the loop knew of the loss are void on the new connection.
            self.end.cut();
        }
    }

    /// Exchanges messages until the stop flag is set.
    fn run_session(&mut self, link: &mut Link, watch: &mut AlarmMonitor) -> Result<(), Ended> {
        while !self.leave.load(Ordering::Acquire) {
            // The loop unparks this thread by a write or by closing.
            std::thread::park_timeout(IDLE);
            let order = self.end.order();
            self.exchange(link, &order, watch)?;
        }
        Ok(())
    }

    /// A new connection, once the service lists the device again; `None` when the stop flag is set.
    fn reconnect(&mut self) -> Option<Link> {
        while !self.leave.load(Ordering::Acquire) {
            if let Ok((link, message)) = inventory(&self.url)
                && message.found().iter().any(|f| f.id == self.id)
            {
                self.spelling = message.spelling();
                self.alarms.is_back();
                return Some(link);
            }
            // Each order of the loop unparks this thread, so the wait is split.
            for _ in 0..RETRY_AFTER.as_millis() {
                std::thread::park_timeout(Duration::from_millis(1));
                if self.leave.load(Ordering::Acquire) {
                    return None;
                }
            }
        }
        None
    }

    /// Sends an order and waits for its answer, and for outstanding ones.
    fn exchange(
        &mut self,
        link: &mut Link,
        order: &Order,
        watch: &mut AlarmMonitor,
    ) -> Result<(), Ended> {
        self.send(link, order)?;
        let mut outstanding = 1;
        while outstanding > 0 {
            match link.receive() {
                Received::Text(text) => {
                    outstanding -= 1;
                    self.apply(&text, watch);
                }
                Received::Nothing if self.leave.load(Ordering::Acquire) => return Ok(()),
                Received::Nothing if outstanding < OUTSTANDING_MAX => {
                    self.send(link, &Order::OFF)?;
                    self.end.cut();
                    outstanding += 1;
                }
                Received::Nothing | Received::Unfit(_) | Received::Closed(_) => return Err(Ended),
            }
        }
        Ok(())
    }

    fn send(&self, link: &mut Link, order: &Order) -> Result<(), Ended> {
        let text = force(&self.id, self.spelling, order.wrench.force);
        link.send(text).map_err(|_| Ended)
    }

    /// Publishes the state in an answer. An invalid answer is ignored: the loop detects missing states.
    fn apply(&mut self, text: &str, watch: &mut AlarmMonitor) {
        let Ok(message) = Message::read(text) else {
            return;
        };
        let Some(mut device_state) = message.device_state(&self.id, &self.device_state) else {
            return;
        };
        device_state.faults = watch.look(&self.alarms);
        if self.alarms.is_gone() {
            device_state.lost = Some(DeviceFault::Unplugged);
        }
        self.device_state = device_state;
        self.end.publish(device_state);
    }
}

//! Safety events: a separate connection on which only the service sends.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use serde::Deserialize;

use super::link::{Link, Received};
use crate::Faults;

/// Wait for an event between two checks of the stop flag.
const WAIT: Duration = Duration::from_millis(100);

/// Time until a service without an event channel is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(2);

/// Number of messages for which a momentary event counts: a quarter to half a second.
const MOMENT: u32 = 250;

/// Present faults, as reported by the service.
#[derive(Debug, Default)]
pub(super) struct Alarms {
    brake: AtomicBool,
    stage: AtomicBool,
    gone: AtomicBool,
    /// Momentary events.
    happened: AtomicU32,
}

impl Alarms {
    /// Whether the service reported the device as gone.
    pub(super) fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Acquire)
    }

    /// The service lists the device again, which ends a disconnection even if the event was missed.
    pub(super) fn is_back(&self) {
        self.gone.store(false, Ordering::Release);
    }

    /// A new connection begins with no alarms. The end of an old alarm may have been missed, and a service repeats
    /// those that persist.
    fn begin(&self) {
        self.brake.store(false, Ordering::Release);
        self.stage.store(false, Ordering::Release);
    }

    /// Applies an event if it concerns device `id`.
    fn apply(&self, id: &str, text: &str) {
        // Unknown events are ignored.
        let Ok(event) = serde_json::from_str::<Event>(text) else {
            return;
        };
        // An event without a device concerns all of them.
        if event.data.device_id.as_deref().is_some_and(|of| of != id) {
            return;
        }
        match (event.name.as_str(), event.data.safety_type.as_deref()) {
            ("device-disconnected", _) => self.gone.store(true, Ordering::Release),
            ("device-connected", _) => self.gone.store(false, Ordering::Release),
            (_, Some("ebrake_triggered")) => self.brake.store(true, Ordering::Release),
            (_, Some("ebrake_released")) => self.brake.store(false, Ordering::Release),
            (_, Some("fod_stage_changed")) => {
                let is_calm = matches!(event.level.as_str(), "info" | "notice");
                self.stage.store(!is_calm, Ordering::Release);
            }
            (_, Some("stall_detected" | "stability_ceiling")) => {
                self.happened.fetch_add(1, Ordering::AcqRel);
            }
            _ => {}
        }
    }
}

/// Evaluates the alarms once per message, on the thread of the states.
#[derive(Debug, Default)]
pub(super) struct AlarmMonitor {
    seen: u32,
    left: u32,
}

impl AlarmMonitor {
    /// The faults of this message.
    pub(super) fn look(&mut self, alarms: &Alarms) -> Faults {
        let happened = alarms.happened.load(Ordering::Acquire);
        if happened == self.seen {
            self.left = self.left.saturating_sub(1);
        } else {
            self.seen = happened;
            self.left = MOMENT;
        }
        let mut faults = Faults::NONE;
        if alarms.brake.load(Ordering::Acquire) {
            faults = faults.with(Faults::EMERGENCY_STOP);
        }
        if self.left > 0 || alarms.stage.load(Ordering::Acquire) {
            faults = faults.with(Faults::OVER_FORCE);
        }
        faults
    }
}

#[derive(Deserialize)]
struct Event {
    name: String,
    #[serde(default)]
    level: String,
    #[serde(default)]
    data: About,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct About {
    device_id: Option<String>,
    safety_type: Option<String>,
}

/// Receives events until `leave` is set. A service before 3.5 has no events; it is tried again from time to time,
/// because a newer one may have replaced it.
pub(super) fn listen(url: &str, id: &str, alarms: &Arc<Alarms>, leave: &AtomicBool) {
    while !leave.load(Ordering::Acquire) {
        if let Ok(mut link) = Link::open(url) {
            alarms.begin();
            link.wait_at_most(WAIT);
            while !leave.load(Ordering::Acquire) {
                match link.receive() {
                    Received::Text(text) => alarms.apply(id, &text),
                    Received::Nothing => {}
                    Received::Unfit(_) | Received::Closed(_) => break,
                }
            }
            link.close();
        }
        if !leave.load(Ordering::Acquire) {
            std::thread::park_timeout(RETRY_AFTER);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{AlarmMonitor, Alarms, MOMENT};
    use crate::Faults;

    fn event(safety: &str, level: &str, id: &str) -> String {
        format!(
            r#"{{"name":"device-safety-triggered","category":"device","level":"{level}",
            "data":{{"device_family":"inverse","device_id":"{id}","safety_type":"{safety}"}},"message":""}}"#
        )
    }

    #[test]
    fn events_become_faults_for_as_long_as_they_last() {
        let (alarms, mut watch) = (Alarms::default(), AlarmMonitor::default());
        let mut after = |text: String| {
            alarms.apply("049D", &text);
            watch.look(&alarms)
        };
        assert_eq!(
            after(event("ebrake_triggered", "error", "049D")),
            Faults::EMERGENCY_STOP
        );
        assert_eq!(after("garbage".to_owned()), Faults::EMERGENCY_STOP);
        assert_eq!(
            after(event("ebrake_released", "notice", "049D")),
            Faults::NONE
        );
        assert_eq!(
            after(event("fod_stage_changed", "warning", "049D")),
            Faults::OVER_FORCE
        );
        assert_eq!(
            after(event("fod_stage_changed", "info", "049D")),
            Faults::NONE
        );
        assert_eq!(
            after(event("ebrake_triggered", "error", "04BA")),
            Faults::NONE
        );
        assert_eq!(
            after(event("stall_detected", "warning", "049D")),
            Faults::OVER_FORCE
        );
        let lasting = (0..MOMENT + 10).filter(|_| after(String::new()) == Faults::OVER_FORCE);
        assert_eq!(lasting.count() as u32, MOMENT - 1);
        assert_eq!(
            after(event("stability_ceiling", "warning", "049D")),
            Faults::OVER_FORCE
        );
    }

    #[test]
    fn a_new_connection_clears_lasting_alarms() {
        let (alarms, mut watch) = (Alarms::default(), AlarmMonitor::default());
        alarms.apply("049D", &event("ebrake_triggered", "error", "049D"));
        alarms.apply("049D", &event("fod_stage_changed", "warning", "049D"));
        let both = Faults::EMERGENCY_STOP.with(Faults::OVER_FORCE);
        assert_eq!(watch.look(&alarms), both);
        alarms.begin();
        assert_eq!(watch.look(&alarms), Faults::NONE);
    }

    #[test]
    fn a_disconnected_device_is_gone_until_it_is_back() {
        let alarms = Alarms::default();
        alarms.apply(
            "1",
            r#"{"name":"device-disconnected","data":{"device_id":"1"}}"#,
        );
        assert!(alarms.is_gone());
        alarms.apply(
            "1",
            r#"{"name":"device-connected","data":{"device_id":"1"}}"#,
        );
        assert!(!alarms.is_gone());
        alarms.apply(
            "1",
            r#"{"name":"device-disconnected","data":{"device_id":"1"}}"#,
        );
        alarms.is_back();
        assert!(!alarms.is_gone());
    }
}

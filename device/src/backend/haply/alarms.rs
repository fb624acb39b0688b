//! Safety events: a conversation of their own, in which only the service speaks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use serde::Deserialize;

use super::link::{Link, Received};
use crate::Faults;

/// How long an event is waited for before it is looked whether to leave.
const WAIT: Duration = Duration::from_millis(100);

/// How long to wait before a service that does not speak of events is asked again.
const AGAIN: Duration = Duration::from_secs(2);

/// Messages for which something that happened once counts: a quarter to half a second.
const MOMENT: u32 = 250;

/// What is wrong now, as far as the service has said.
#[derive(Debug, Default)]
pub(super) struct Alarms {
    brake: AtomicBool,
    stage: AtomicBool,
    gone: AtomicBool,
    /// Things that happened once.
    happened: AtomicU32,
}

impl Alarms {
    /// Whether the service said that the device is gone.
    pub(super) fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Acquire)
    }

    /// The service lists the device again: that it went is over, whether or not anybody heard it come back.
    pub(super) fn is_back(&self) {
        self.gone.store(false, Ordering::Release);
    }

    /// A new conversation begins. What lasted in the old one may have ended while nobody listened; a service that
    /// restarted knows nothing of it, and one that still means it says so again.
    fn begin(&self) {
        self.brake.store(false, Ordering::Release);
        self.stage.store(false, Ordering::Release);
    }

    /// Takes an event to heart if it is about device `id`.
    fn hear(&self, id: &str, text: &str) {
        // What can not be read is none of the events that are known.
        let Ok(event) = serde_json::from_str::<Event>(text) else {
            return;
        };
        // An event without a device is about all of them.
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

/// The thread of the states looks at the alarms once per message.
#[derive(Debug, Default)]
pub(super) struct Watch {
    seen: u32,
    left: u32,
}

impl Watch {
    /// What the alarms mean for this message.
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

/// Listens until it is told to leave. A service of before 3.5 has no events; it is asked again now and then, as it may
/// have been replaced by a newer one.
pub(super) fn listen(url: &str, id: &str, alarms: &Arc<Alarms>, leave: &AtomicBool) {
    while !leave.load(Ordering::Acquire) {
        if let Ok(mut link) = Link::open(url) {
            alarms.begin();
            link.wait_at_most(WAIT);
            while !leave.load(Ordering::Acquire) {
                match link.receive() {
                    Received::Text(text) => alarms.hear(id, &text),
                    Received::Nothing => {}
                    Received::Unfit(_) | Received::Closed(_) => break,
                }
            }
            link.close();
        }
        if !leave.load(Ordering::Acquire) {
            std::thread::park_timeout(AGAIN);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Alarms, MOMENT, Watch};
    use crate::Faults;

    fn event(safety: &str, level: &str, id: &str) -> String {
        format!(
            r#"{{"name":"device-safety-triggered","category":"device","level":"{level}",
            "data":{{"device_family":"inverse","device_id":"{id}","safety_type":"{safety}"}},"message":""}}"#
        )
    }

    #[test]
    fn events_become_faults_for_as_long_as_they_last() {
        let (alarms, mut watch) = (Alarms::default(), Watch::default());
        let mut after = |text: String| {
            alarms.hear("049D", &text);
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
    fn what_lasted_in_a_conversation_ends_with_the_next_one() {
        let (alarms, mut watch) = (Alarms::default(), Watch::default());
        alarms.hear("049D", &event("ebrake_triggered", "error", "049D"));
        alarms.hear("049D", &event("fod_stage_changed", "warning", "049D"));
        let both = Faults::EMERGENCY_STOP.with(Faults::OVER_FORCE);
        assert_eq!(watch.look(&alarms), both);
        alarms.begin();
        assert_eq!(watch.look(&alarms), Faults::NONE);
    }

    #[test]
    fn a_device_that_is_disconnected_is_gone_until_it_is_back() {
        let alarms = Alarms::default();
        alarms.hear(
            "1",
            r#"{"name":"device-disconnected","data":{"device_id":"1"}}"#,
        );
        assert!(alarms.is_gone());
        alarms.hear(
            "1",
            r#"{"name":"device-connected","data":{"device_id":"1"}}"#,
        );
        assert!(!alarms.is_gone());
        alarms.hear(
            "1",
            r#"{"name":"device-disconnected","data":{"device_id":"1"}}"#,
        );
        alarms.is_back();
        assert!(!alarms.is_gone());
    }
}

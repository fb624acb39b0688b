//! The service's messages, by its maker's documentation of versions 3.0 to 3.5.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::backend::found::Found;
use crate::backend::mailbox::DeviceState;
use crate::{Buttons, Calibration, DeviceFault};

/// JSON key of a force.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Spelling {
    /// Since 3.5.
    Vector,
    /// Before.
    Values,
}

/// A message of the service: all devices with their states, and their descriptions in the first one.
#[derive(Debug, Deserialize)]
pub(super) struct Message {
    inverse3: Option<Vec<Inverse3>>,
    #[serde(default)]
    wireless_verse_grip: Vec<Grip>,
    #[serde(default)]
    verse_grip: Vec<Grip>,
    session_id: Option<Value>,
}

#[derive(Debug, Deserialize)]
struct Inverse3 {
    device_id: String,
    config: Option<Config>,
    state: Option<State>,
    status: Option<Status>,
}

#[derive(Debug, Deserialize)]
struct Config {
    #[serde(rename = "type")]
    kind: Option<String>,
    handedness: Option<String>,
}

#[derive(Debug, Deserialize)]
struct State {
    cursor_position: Option<Xyz>,
    cursor_velocity: Option<Xyz>,
    control_mode: Option<Value>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct Xyz {
    x: f64,
    y: f64,
    z: f64,
}

impl From<Xyz> for Vector3<f64> {
    fn from(v: Xyz) -> Self {
        Self::new(v.x, v.y, v.z)
    }
}

#[derive(Debug, Deserialize)]
struct Status {
    calibrated: Option<bool>,
    power_supply: Option<bool>,
}

#[derive(Debug, Deserialize)]
struct Grip {
    state: Option<GripState>,
}

#[derive(Debug, Deserialize)]
struct GripState {
    orientation: Option<Turn>,
    /// Of a grip with a cable.
    #[serde(default)]
    button: bool,
    /// Of a wireless one.
    buttons: Option<Abc>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct Turn {
    w: f64,
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Abc {
    a: bool,
    b: bool,
    c: bool,
}

impl Message {
    /// Parses a message; an error contains the reason and the beginning of the message.
    pub(super) fn read(text: &str) -> Result<Self, String> {
        let message: Self = serde_json::from_str(text).map_err(|why| {
            let begins: String = text.chars().take(60).collect();
            format!("{why}, in a message that begins with {begins:?}")
        })?;
        if message.inverse3.is_none() {
            let begins: String = text.chars().take(60).collect();
            return Err(format!("it lists no inverse3, and begins with {begins:?}"));
        }
        Ok(message)
    }

    fn devices(&self) -> &[Inverse3] {
        self.inverse3.as_deref().unwrap_or_default()
    }

    /// The devices it lists.
    pub(super) fn found(&self) -> Vec<Found> {
        let found = |device: &Inverse3| {
            let config = device.config.as_ref();
            let kind = config.and_then(|c| c.kind.as_deref()).unwrap_or("inverse3");
            let hand = config.and_then(|c| c.handedness.as_deref());
            Found {
                id: device.device_id.clone(),
                name: match hand {
                    Some(hand) => format!("Haply {kind}, {hand}-handed"),
                    None => format!("Haply {kind}"),
                },
                // The service does not report use by other programs.
                is_free: true,
            }
        };
        self.devices().iter().map(found).collect()
    }

    /// The spelling of forces by this service: sessions have numbers, and devices a control mode, since both use
    /// `vector`.
    pub(super) fn spelling(&self) -> Spelling {
        let has_mode = |d: &Inverse3| d.state.as_ref().is_some_and(|s| s.control_mode.is_some());
        if self.session_id.is_some() || self.devices().iter().any(has_mode) {
            Spelling::Vector
        } else {
            Spelling::Values
        }
    }

    /// Whether a grip reports the orientation of the tool.
    pub(super) fn has_grip(&self) -> bool {
        self.grip().is_some()
    }

    fn grip(&self) -> Option<&GripState> {
        let grips = self.wireless_verse_grip.iter().chain(&self.verse_grip);
        grips
            .filter_map(|g| g.state.as_ref())
            .find(|g| g.orientation.is_some())
    }

    /// State of device `id`; missing fields keep their value in `before`. Faults are not included.
    ///
    /// `None` for a message without a valid position of the device.
    pub(super) fn device_state(&self, id: &str, before: &DeviceState) -> Option<DeviceState> {
        let Some(device) = self.devices().iter().find(|d| d.device_id == id) else {
            return Some(DeviceState {
                lost: Some(DeviceFault::Unplugged),
                ..*before
            });
        };
        let state = device.state.as_ref()?;
        let mut device_state = DeviceState {
            lost: None,
            velocity: state
                .cursor_velocity
                .map_or_else(Vector3::zeros, Into::into),
            ..*before
        };
        device_state.pose.position = state.cursor_position?.into();
        if let Some(status) = &device.status {
            device_state.powered = status.power_supply.unwrap_or(true);
            device_state.calibration = match status.calibrated {
                Some(false) => Calibration::NeedsUser,
                _ => Calibration::Done,
            };
        }
        if let Some(grip) = self.grip() {
            if let Some(turn) = grip.orientation {
                let turn = Quaternion::new(turn.w, turn.x, turn.y, turn.z);
                // A sleeping grip reports a zero quaternion.
                if (0.5..2.0).contains(&turn.norm()) {
                    device_state.pose.orientation = UnitQuaternion::new_normalize(turn);
                }
            }
            device_state.buttons = buttons(grip);
        }
        let is_number =
            device_state.pose.is_finite() && device_state.velocity.iter().all(|c| c.is_finite());
        is_number.then_some(device_state)
    }
}

fn buttons(grip: &GripState) -> Buttons {
    let abc = grip.buttons.as_ref();
    let bit = |held: bool, n: u32| u32::from(held) << n;
    Buttons::from_bits(
        bit(grip.button || abc.is_some_and(|b| b.a), 0)
            | bit(abc.is_some_and(|b| b.b), 1)
            | bit(abc.is_some_and(|b| b.c), 2),
    )
}

/// The command by which device `id` renders `force`, N.
pub(super) fn force(id: &str, spelling: Spelling, force: Vector3<f64>) -> String {
    let xyz = json!({ "x": force.x, "y": force.y, "z": force.z });
    let command = match spelling {
        Spelling::Vector => json!({ "vector": xyz, "execute": true }),
        Spelling::Values => json!({ "values": xyz }),
    };
    let device = json!({ "device_id": id, "commands": { "set_cursor_force": command } });
    json!({ "inverse3": [device] }).to_string()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::{DeviceState, Message, Spelling, force};
    use crate::{Buttons, Calibration, DeviceFault};

    /// An inventory of version 3.4.
    const OLD: &str = r#"{"inverse3":[{"device_id":"04BA","config":{"type":"inverse3","handedness":"right"},
        "state":{"cursor_position":{"x":0.078,"y":-0.148,"z":0.143},"cursor_velocity":{"x":-0.01,"y":0.0,"z":-0.04},
        "mode":"idle"},"status":{"calibrated":false,"power_supply":true,"ready":true}}],
        "verse_grip":[{"device_id":"61548","state":{"button":true,"hall":0,
        "orientation":{"x":0.0,"y":1.0,"z":0.0,"w":0.0}}}]}"#;

    #[test]
    fn the_older_inventory_is_read() {
        let message = Message::read(OLD).unwrap();
        assert_eq!(message.spelling(), Spelling::Values);
        assert_eq!(
            message.found()[0].to_string(),
            "04BA (Haply inverse3, right-handed)"
        );
        let device_state = message
            .device_state("04BA", &DeviceState::at_rest())
            .unwrap();
        assert_eq!(
            device_state.pose.position,
            Vector3::new(0.078, -0.148, 0.143)
        );
        assert_eq!(device_state.velocity.z, -0.04);
        assert!((device_state.pose.orientation * Vector3::x() + Vector3::x()).norm() < 1e-12);
        assert_eq!(
            (device_state.buttons, device_state.calibration),
            (Buttons::PRIMARY, Calibration::NeedsUser)
        );
        let gone = message
            .device_state("049D", &DeviceState::at_rest())
            .unwrap();
        assert_eq!(gone.lost, Some(DeviceFault::Unplugged));
    }

    #[test]
    fn the_newer_inventory_is_read() {
        let text = r#"{"session_id":7,"inverse3":[{"device_id":"049D","state":{"control_mode":"idle",
            "cursor_position":{"x":0,"y":0,"z":0.1}}}],"wireless_verse_grip":[{"state":{
            "orientation":{"x":0,"y":0,"z":0,"w":0},"buttons":{"a":false,"b":true,"c":true}}}]}"#;
        let message = Message::read(text).unwrap();
        assert_eq!(message.spelling(), Spelling::Vector);
        let device_state = message
            .device_state("049D", &DeviceState::at_rest())
            .unwrap();
        assert_eq!(device_state.buttons, Buttons::from_bits(0b110));
        assert_eq!(
            device_state.pose.orientation,
            DeviceState::at_rest().pose.orientation
        );
    }

    #[test]
    fn an_invalid_state_is_ignored() {
        let no_place = r#"{"inverse3":[{"device_id":"1","state":{}}]}"#;
        let message = Message::read(no_place).unwrap();
        assert_eq!(message.device_state("1", &DeviceState::at_rest()), None);
        for (text, word) in [
            ("", "EOF"),
            ("[]", "begins with"),
            ("{}", "no inverse3"),
            ("hello", "hello"),
        ] {
            let why = Message::read(text).unwrap_err();
            assert!(why.contains(word), "{why}");
        }
    }

    #[test]
    fn forces_are_written_in_both_spellings() {
        let there = Vector3::new(1.0, -2.0, 0.5);
        assert_eq!(
            force("049D", Spelling::Vector, there),
            r#"{"inverse3":[{"commands":{"set_cursor_force":{"execute":true,"vector":{"x":1.0,"y":-2.0,"z":0.5}}},"device_id":"049D"}]}"#
        );
        assert!(force("049D", Spelling::Values, there).contains(r#""values":{"x":1.0"#));
    }

    proptest! {
        #[test]
        fn no_text_panics(text in ".{0,200}", cut in 0..400_usize) {
            let _ = Message::read(&text);
            let cut = OLD.char_indices().map(|(i, _)| i).take_while(|i| *i < cut).last().unwrap_or(0);
            if let Ok(message) = Message::read(&OLD[..cut]) {
                let _ = message.device_state("04BA", &DeviceState::at_rest());
            }
        }
    }
}

//! The hardware's port: gamepads through the crate gilrs, which knows the layouts of some thousand models.

use std::time::Duration;

use gilrs::ff::{BaseEffect, BaseEffectType, Effect, EffectBuilder};
use gilrs::{Button, EventType, GamepadId, Gilrs, GilrsBuilder};

use super::{Axis, DeviceLost, Key, PadEvent, Port, Trigger, over};
use crate::OpenError;
use crate::backend::steered::{RateControl, Space, Steered, no_search, not_found};

const WHAT: &str = "gamepad";

/// Steers a tool in `space` with the first gamepad that is connected.
pub fn open(rate: RateControl, space: &Space) -> Result<Steered, OpenError> {
    // No filters of gilrs: they have a dead zone per stick; rate control has one for all axes together.
    let builder = GilrsBuilder::new().with_default_filters(false);
    let mut library = builder.build().map_err(|e| no_search(WHAT, e))?;
    let first = library.gamepads().next();
    let (id, name) = first
        .map(|(id, pad)| (id, pad.name().to_owned()))
        .ok_or_else(|| not_found(WHAT))?;
    let shake = shake(&mut library, id);
    let port = Pads {
        all: library,
        id,
        shake,
    };
    over(port, name, rate, space)
}

/// Both motors of a pad at full strength, to be turned down; `None` for a pad without motors.
fn shake(library: &mut Gilrs, id: GamepadId) -> Option<Effect> {
    let magnitude = u16::MAX;
    let both = [
        BaseEffectType::Strong { magnitude },
        BaseEffectType::Weak { magnitude },
    ];
    let mut builder = EffectBuilder::new();
    for kind in both {
        builder.add_effect(BaseEffect {
            kind,
            ..BaseEffect::default()
        });
    }
    let effect = builder.gain(0.0).gamepads(&[id]).finish(library).ok()?;
    effect.play().ok()?;
    Some(effect)
}

/// The port over the library. It changes the motors itself, every 50 ms, with the newest strength.
struct Pads {
    all: Gilrs,
    id: GamepadId,
    shake: Option<Effect>,
}

impl Port for Pads {
    fn event(&mut self, patience: Duration) -> Result<Option<PadEvent>, DeviceLost> {
        let event = self.all.next_event_blocking(Some(patience));
        match event.filter(|event| event.id == self.id) {
            Some(event) if event.event == EventType::Disconnected => {
                self.shake = None;
                Err(DeviceLost)
            }
            Some(event) => Ok(translated(event.event)),
            None => Ok(None),
        }
    }

    fn reopen(&mut self) -> bool {
        // Pads come and go as events.
        while self.all.next_event().is_some() {}
        let Some((id, _)) = self.all.gamepads().next() else {
            return false;
        };
        self.id = id;
        self.shake = shake(&mut self.all, id);
        true
    }

    fn rumble(&mut self, strength: f32) {
        if let Some(shake) = &self.shake {
            // A failed cue is harmless.
            let _ = shake.set_gain(strength);
        }
    }
}

/// The corresponding event; `None` for events without a meaning here.
fn translated(event: EventType) -> Option<PadEvent> {
    match event {
        EventType::AxisChanged(axis, place, _) => {
            let axis = match axis {
                gilrs::Axis::LeftStickX => Axis::LeftX,
                gilrs::Axis::LeftStickY => Axis::LeftY,
                gilrs::Axis::RightStickX => Axis::RightX,
                gilrs::Axis::RightStickY => Axis::RightY,
                gilrs::Axis::DPadX => Axis::CrossX,
                gilrs::Axis::DPadY => Axis::CrossY,
                _ => return None,
            };
            Some(PadEvent::Stick(axis, f64::from(place)))
        }
        EventType::ButtonChanged(button, place, _) => {
            let side = match button {
                Button::LeftTrigger2 => Trigger::Left,
                Button::RightTrigger2 => Trigger::Right,
                _ => return None,
            };
            Some(PadEvent::Trigger(side, f64::from(place)))
        }
        EventType::ButtonPressed(button, _) => key(button).map(|key| PadEvent::Key(key, true)),
        EventType::ButtonReleased(button, _) => key(button).map(|key| PadEvent::Key(key, false)),
        _ => None,
    }
}

fn key(button: Button) -> Option<Key> {
    Some(match button {
        Button::South => Key::South,
        Button::East => Key::East,
        Button::West => Key::West,
        Button::North => Key::North,
        Button::LeftTrigger => Key::LeftShoulder,
        Button::RightTrigger => Key::RightShoulder,
        Button::Select => Key::Select,
        Button::Start => Key::Start,
        Button::DPadLeft => Key::CrossLeft,
        Button::DPadRight => Key::CrossRight,
        Button::DPadUp => Key::CrossUp,
        Button::DPadDown => Key::CrossDown,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use gilrs::Button;

    use super::key;
    use crate::backend::gamepad::Key;

    #[test]
    fn the_first_trigger_of_gilrs_is_a_shoulder() {
        assert_eq!(key(Button::RightTrigger), Some(Key::RightShoulder));
        assert_eq!(key(Button::RightTrigger2), None);
        assert_eq!(key(Button::Mode), None);
    }
}

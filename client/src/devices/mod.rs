//! The supported haptic devices: their kinds, opening one, and commands outside of a session.

mod command;
mod guide;
mod held_device;
mod input;
mod opened;
mod owned;
mod plot;
mod script_tool;
mod selection;

use clap::ValueEnum;
use palpate_device::OpenError;
use palpate_device::backend::five_dof;
use palpate_device::backend::replay::Replay;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use serde::Serialize;

pub(crate) use command::{DevicesArguments, run};
pub(crate) use guide::{Guide, Moves};
pub(crate) use held_device::HeldDevice;
pub(crate) use opened::Opened;
pub use owned::Sources;
pub use script_tool::tool_description;
pub(crate) use selection::DeviceSelection;

/// Kinds of supported devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum DeviceKind {
    /// The best one that is present.
    Auto,
    /// A simulated hand that follows a script and feels the force.
    Sim,
    /// The simulated 5-DOF device of 2007, in the hand of a script.
    FiveDof,
    /// A recorded motion that ignores forces.
    Replay,
    /// A Haply Inverse3.
    Haply,
    /// A Touch or Phantom, through OpenHaptics.
    #[value(name = "openhaptics")]
    #[serde(rename = "openhaptics")]
    OpenHaptics,
    /// A device of Force Dimension, or a Novint Falcon.
    Dhd,
    /// A 6-DOF mouse: push and twist its cap to move the tool.
    #[value(name = "spacemouse")]
    #[serde(rename = "spacemouse")]
    SpaceMouse,
    /// A gamepad: its sticks move the tool, and it rumbles at contact.
    Gamepad,
    /// Mouse, touch and keyboard, through the page of the browser view.
    Pointer,
}

impl DeviceKind {
    /// All kinds with a description: first those that follow a file, then those that a hand holds, with force before
    /// without.
    pub const ALL: [(Self, &'static str); 9] = [
        (
            Self::Sim,
            "a simulated hand that follows a script (--script FILE) and feels the force",
        ),
        (
            Self::FiveDof,
            "the 5-DOF device of 2007 with simulated motors and encoders, in the hand of a script (--script FILE)",
        ),
        (
            Self::Replay,
            "a recorded motion (--motion FILE) that ignores forces",
        ),
        (
            Self::Dhd,
            "a delta, omega or sigma of Force Dimension, or a Novint Falcon, in your hand",
        ),
        (Self::Haply, "a Haply Inverse3 in your hand"),
        (
            Self::OpenHaptics,
            "a Touch or Phantom (OpenHaptics) in your hand",
        ),
        (
            Self::SpaceMouse,
            "a 6-DOF mouse: push and twist its cap to move the tool; no force",
        ),
        (
            Self::Gamepad,
            "a gamepad: its sticks move the tool, its triggers close; no force, but it shakes at contact",
        ),
        (
            Self::Pointer,
            "mouse, touch and keyboard, through the page of `join --view`; no force",
        ),
    ];

    /// The command line word.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Sim => "sim",
            Self::FiveDof => "five-dof",
            Self::Replay => "replay",
            Self::Haply => "haply",
            Self::OpenHaptics => "openhaptics",
            Self::Dhd => "dhd",
            Self::SpaceMouse => "spacemouse",
            Self::Gamepad => "gamepad",
            Self::Pointer => "pointer",
        }
    }

    /// Whether it is a commercial motorised device, of which none or several may be connected.
    pub(crate) const fn is_owned(self) -> bool {
        matches!(self, Self::Haply | Self::OpenHaptics | Self::Dhd)
    }

    /// Whether it steers a tool and renders no force.
    pub(crate) const fn is_steered(self) -> bool {
        matches!(self, Self::SpaceMouse | Self::Gamepad | Self::Pointer)
    }

    /// Whether the user's hand moves it, instead of a script or a recording.
    pub(crate) const fn is_held(self) -> bool {
        self.is_owned() || self.is_steered()
    }

    /// Resolves `auto` to the best present device that suits the guide.
    pub(crate) fn chosen(self, guide: &Guide) -> Self {
        match (self, &guide.moves) {
            // A script or a motion needs a simulated hand. A connected device moves only in its user's hand.
            (Self::Auto, Moves::Script(_)) => Self::Sim,
            (Self::Auto, Moves::Motion(_)) => Self::Replay,
            (Self::Auto, Moves::Held(hold)) => hold.kind,
            (other, _) => other,
        }
    }
}

/// Reason why a device can not be opened.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// The device can not follow the script.
    #[error("the device five-dof can not follow this script: {0}")]
    FiveDof(OpenError),
    /// It is not connected or not available.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// A different source moves it.
    #[error("the device {device} is moved by {moves}: give {option} FILE, and not {instead}")]
    MovedOtherwise {
        /// The device.
        device: &'static str,
        /// Its source of motion.
        moves: &'static str,
        /// The option for that source.
        option: &'static str,
        /// The option that was given.
        instead: &'static str,
    },
    /// The user's hand moves it.
    #[error(
        "the device {0} is moved by your own hand: leave out --motion (a --script only gives its tool and initial pose)"
    )]
    HandMoved(&'static str),
    /// It needs a view.
    #[error(
        "the device pointer needs --view: mouse, touch and keys reach it through a page; add --view, or choose another \
         device"
    )]
    NeedsView,
    /// This program was built without it.
    #[error("this program was built without the device {0}; rebuild with `--features {0}`")]
    BuiltWithout(&'static str),
}

/// Opens a device with its guide. A held motorised device stays in its own frame until [`HeldDevice::placed`] places it in
/// the scene. [`Guide::load`] rejects a pointer without a view, which nothing would move.
pub(crate) fn open(
    choice: &DeviceSelection,
    guide: &Guide,
    start: ScriptStart,
    sources: &Sources,
) -> Result<Opened, DeviceError> {
    let kind = choice.kind.chosen(guide);
    let other = |moves, option, instead| DeviceError::MovedOtherwise {
        device: kind.word(),
        moves,
        option,
        instead,
    };
    Ok(match (kind, &guide.moves) {
        (DeviceKind::FiveDof, Moves::Script(script)) => {
            Opened::new(five_dof::simulated(script, start).map_err(DeviceError::FiveDof)?)
        }
        (DeviceKind::Sim | DeviceKind::Auto, Moves::Script(script)) => {
            Opened::new(SimHand::new(script.clone(), start))
        }
        (DeviceKind::Replay, Moves::Motion(motion)) => {
            Opened::new(Replay::new(motion.clone(), start))
        }
        (DeviceKind::Replay, Moves::Script(_)) => {
            return Err(other("a recorded motion", "--motion", "--script alone"));
        }
        (steered, Moves::Held(hold)) if steered.is_steered() => {
            input::open(steered, &hold.space())?
        }
        (held, Moves::Held(_)) => {
            let opened = owned::open(held, choice.which.as_deref(), sources)?;
            let device = opened.ok_or_else(|| other("a script", "--script", "your own hand"))?;
            Opened {
                device,
                pointer: None,
            }
        }
        (held, _) if held.is_held() => return Err(DeviceError::HandMoved(held.word())),
        (_, Moves::Script(_) | Moves::Motion(_)) => {
            return Err(other("a script", "--script", "--motion"));
        }
    })
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::{
        DeviceError, DeviceKind, DeviceSelection, Guide, Opened, ScriptStart, Sources, open,
    };

    /// Result of opening a device of this kind without vendor files.
    fn opened(kind: DeviceKind, guide: &Guide) -> Result<Opened, DeviceError> {
        let choice = DeviceSelection { kind, which: None };
        open(&choice, guide, ScriptStart::not_yet(), &Sources::default())
    }

    #[test]
    fn device_word_is_the_same_everywhere() {
        for (kind, _) in DeviceKind::ALL {
            assert_eq!(DeviceKind::from_str(kind.word(), false), Ok(kind));
            let json = serde_json::to_value(kind).unwrap();
            assert_eq!(json, kind.word());
        }
    }

    #[test]
    fn missing_feature_error_names_the_feature() {
        for (kind, built) in [
            (DeviceKind::SpaceMouse, cfg!(feature = "spacemouse")),
            (DeviceKind::Gamepad, cfg!(feature = "gamepad")),
        ] {
            if built {
                continue;
            }
            let error = opened(kind, &Guide::held(None, kind)).err();
            let said = error.unwrap().to_string();
            assert!(
                said.contains(&format!("`--features {}`", kind.word())),
                "{said}"
            );
        }
    }

    #[test]
    fn motion_is_rejected_for_held_devices() {
        let guide = Guide::at_rest(true).unwrap();
        for (kind, _) in DeviceKind::ALL.into_iter().filter(|(k, _)| k.is_held()) {
            let said = opened(kind, &guide).err().unwrap().to_string();
            assert!(
                said.contains("leave out --motion") && said.contains(kind.word()),
                "{said}"
            );
        }
    }
}

//! The devices that this program drives: which there are, opening one, and what is done with one outside of a session.

mod command;
mod guide;
mod input;
mod plot;

use clap::ValueEnum;
use palpate_device::HapticDevice;
use palpate_device::backend::five_dof;
use palpate_device::backend::replay::Replay;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::backend::steered::OpenError;
use serde::Serialize;

pub(crate) use command::{DevicesArguments, run};
pub(crate) use guide::{Guide, Moves};

/// The kinds of devices that this program drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum DeviceKind {
    /// The best one that is present.
    Auto,
    /// A simulated hand that follows a script and feels the force.
    Sim,
    /// The 5-DOF device of 2007 on simulated boards, in the hand of a script.
    FiveDof,
    /// A recorded motion, whatever pushes it.
    Replay,
    /// Mouse and keyboard, through a view.
    Pointer,
    /// A 6-DOF mouse: push and twist its cap to move the tool.
    #[value(name = "spacemouse")]
    #[serde(rename = "spacemouse")]
    SpaceMouse,
    /// A gamepad: its sticks move the tool, and it shakes at contact.
    Gamepad,
}

impl DeviceKind {
    /// All that can be opened, with a sentence each; the best first.
    pub const ALL: [(Self, &'static str); 6] = [
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
            "a recorded motion (--motion FILE) that goes its way whatever pushes it",
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
            "mouse and keyboard, through the browser view; no force",
        ),
    ];

    /// The word for it on the command line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Sim => "sim",
            Self::FiveDof => "five-dof",
            Self::Replay => "replay",
            Self::Pointer => "pointer",
            Self::SpaceMouse => "spacemouse",
            Self::Gamepad => "gamepad",
        }
    }

    /// Whether a hand of flesh and blood moves it, and no script.
    pub(crate) const fn is_steered(self) -> bool {
        matches!(self, Self::Pointer | Self::SpaceMouse | Self::Gamepad)
    }

    /// The device that is meant: of `auto`, the best that is present and can be moved so.
    pub(crate) fn chosen(self, guide: &Guide) -> Self {
        match (self, &guide.moves) {
            // None of them needs hardware; a hand without a device is the truest one.
            (Self::Auto, Moves::Script(_)) => Self::Sim,
            (Self::Auto, Moves::Motion(_)) => Self::Replay,
            (other, _) => other,
        }
    }
}

/// Why a device can not be opened.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// The script can not be followed with it.
    #[error("the device five-dof can not follow this script: {0}")]
    FiveDof(#[from] five_dof::Unsuited),
    /// Something else moves it.
    #[error("the device {device} is moved by {moves}: give {option} FILE, and not {instead}")]
    MovedOtherwise {
        /// The device.
        device: &'static str,
        /// What moves it.
        moves: &'static str,
        /// The option for that.
        option: &'static str,
        /// What was given.
        instead: &'static str,
    },
    /// A hand moves it.
    #[error(
        "the device {0} is moved by your own hand: leave out --motion (a --script only says which tool it is and where \
         it begins)"
    )]
    HandMoved(&'static str),
    /// It needs a view.
    #[error(
        "the device pointer needs the browser view, which this program does not have yet; choose another device"
    )]
    NeedsView,
    /// This program was built without it.
    #[error("this program was built without the device {0}; rebuild with `--features {0}`")]
    BuiltWithout(&'static str),
    /// It is not there, or not to be had.
    #[error(transparent)]
    Input(#[from] OpenError),
}

/// Opens a device that is moved by its guide.
pub(crate) fn open(
    kind: DeviceKind,
    guide: &Guide,
    start: ScriptStart,
) -> Result<Box<dyn HapticDevice>, DeviceError> {
    let kind = kind.chosen(guide);
    let other = |moves, option, instead| DeviceError::MovedOtherwise {
        device: kind.word(),
        moves,
        option,
        instead,
    };
    Ok(match (kind, &guide.moves) {
        (DeviceKind::FiveDof, Moves::Script(script)) => {
            Box::new(five_dof::simulated(script, start)?)
        }
        (DeviceKind::Sim | DeviceKind::Auto, Moves::Script(script)) => {
            Box::new(SimHand::new(script.clone(), start))
        }
        (DeviceKind::Replay, Moves::Motion(motion)) => Box::new(Replay::new(motion.clone(), start)),
        (DeviceKind::Replay, Moves::Script(_)) => {
            return Err(other("a recorded motion", "--motion", "--script alone"));
        }
        (steered, Moves::Hand(space)) => return input::open(steered, space),
        (steered, Moves::Motion(_)) if steered.is_steered() => {
            return Err(DeviceError::HandMoved(steered.word()));
        }
        (_, Moves::Motion(_)) => return Err(other("a script", "--script", "--motion")),
        (steered, Moves::Script(_)) => return Err(DeviceError::HandMoved(steered.word())),
    })
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::{DeviceKind, Guide, ScriptStart, open};

    #[test]
    fn a_device_has_one_word_everywhere() {
        for (kind, _) in DeviceKind::ALL {
            assert_eq!(DeviceKind::from_str(kind.word(), false), Ok(kind));
            let json = serde_json::to_value(kind).unwrap();
            assert_eq!(json, kind.word());
        }
    }

    #[test]
    fn what_this_program_was_built_without_is_said_with_what_to_do() {
        for (kind, built) in [
            (DeviceKind::SpaceMouse, cfg!(feature = "spacemouse")),
            (DeviceKind::Gamepad, cfg!(feature = "gamepad")),
        ] {
            if built {
                continue;
            }
            let error = open(kind, &Guide::held(), ScriptStart::not_yet()).err();
            let said = error.unwrap().to_string();
            assert!(
                said.contains(&format!("`--features {}`", kind.word())),
                "{said}"
            );
        }
    }

    #[test]
    fn a_motion_does_not_move_what_a_hand_holds() {
        let guide = Guide::at_rest(true).unwrap();
        let error = open(DeviceKind::Gamepad, &guide, ScriptStart::not_yet()).err();
        let said = error.unwrap().to_string();
        assert!(said.contains("leave out --motion"), "{said}");
    }
}

//! The devices that this program drives: which there are, opening one, and what is done with one outside of a session.

mod choice;
mod command;
mod guide;
mod hold;
mod input;
mod owned;
mod plot;

use clap::ValueEnum;
use palpate_device::HapticDevice;
use palpate_device::backend::five_dof;
use palpate_device::backend::replay::Replay;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::backend::steered::OpenError;
use serde::Serialize;

pub(crate) use choice::DeviceChoice;
pub(crate) use command::{DevicesArguments, run};
pub(crate) use guide::{Guide, Moves};
pub(crate) use hold::Hold;
pub use owned::{OwnedError, Sources};

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
    /// A gamepad: its sticks move the tool, and it shakes at contact.
    Gamepad,
    /// Mouse and keyboard, through a view.
    Pointer,
}

impl DeviceKind {
    /// All that this program knows, with a sentence each: what follows a file, then what a hand holds, with force
    /// before without.
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
            "a recorded motion (--motion FILE) that goes its way whatever pushes it",
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
            Self::Haply => "haply",
            Self::OpenHaptics => "openhaptics",
            Self::Dhd => "dhd",
            Self::SpaceMouse => "spacemouse",
            Self::Gamepad => "gamepad",
            Self::Pointer => "pointer",
        }
    }

    /// Whether it is a device with motors that somebody owns: there may be none, or several.
    pub(crate) const fn is_owned(self) -> bool {
        matches!(self, Self::Haply | Self::OpenHaptics | Self::Dhd)
    }

    /// Whether it steers a tool and renders no force.
    pub(crate) const fn is_steered(self) -> bool {
        matches!(self, Self::SpaceMouse | Self::Gamepad | Self::Pointer)
    }

    /// Whether a hand of flesh and blood moves it, and neither script nor motion.
    pub(crate) const fn is_held(self) -> bool {
        self.is_owned() || self.is_steered()
    }

    /// The device that is meant: of `auto`, the best that is present and can be moved so.
    pub(crate) fn chosen(self, guide: &Guide) -> Self {
        match (self, &guide.moves) {
            // Whoever gives a script or a motion asks for a hand that is not his own; without a device in it it is the
            // truest one. A device that is plugged in moves only for whoever holds it.
            (Self::Auto, Moves::Script(_)) => Self::Sim,
            (Self::Auto, Moves::Motion(_)) => Self::Replay,
            (Self::Auto, Moves::Held(hold)) => hold.kind,
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
    /// It is not there, or not to be had.
    #[error(transparent)]
    Owned(#[from] OwnedError),
    /// The same of one that steers.
    #[error(transparent)]
    Input(#[from] OpenError),
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
        "the device {0} is moved by your own hand: leave out --motion (a --script only says which tool it is, and where)"
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
}

/// Opens a device that is moved by its guide. One with motors that somebody holds is where its maker has it:
/// [`Hold::placed`] puts it into the scene.
pub(crate) fn open(
    choice: &DeviceChoice,
    guide: &Guide,
    start: ScriptStart,
    sources: &Sources,
) -> Result<Box<dyn HapticDevice>, DeviceError> {
    let kind = choice.kind.chosen(guide);
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
        (steered, Moves::Held(hold)) if steered.is_steered() => {
            return input::open(steered, &hold.space());
        }
        (held, Moves::Held(_)) => {
            let opened = owned::open(held, choice.which.as_deref(), sources)?;
            return opened.ok_or_else(|| other("a script", "--script", "your own hand"));
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

    use palpate_device::HapticDevice;

    use super::{DeviceChoice, DeviceError, DeviceKind, Guide, ScriptStart, Sources, open};

    /// What comes of opening one of this kind, wherever makers have their files.
    fn opened(kind: DeviceKind, guide: &Guide) -> Result<Box<dyn HapticDevice>, DeviceError> {
        let choice = DeviceChoice { kind, which: None };
        open(&choice, guide, ScriptStart::not_yet(), &Sources::default())
    }

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
            let error = opened(kind, &Guide::held(None, kind)).err();
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
        for (kind, _) in DeviceKind::ALL.into_iter().filter(|(k, _)| k.is_held()) {
            let said = opened(kind, &guide).err().unwrap().to_string();
            assert!(
                said.contains("leave out --motion") && said.contains(kind.word()),
                "{said}"
            );
        }
    }
}

//! The devices that this program drives: which there are, opening one, and what is done with one outside of a session.

mod choice;
mod command;
mod guide;
mod owned;
mod plot;

use clap::ValueEnum;
use palpate_device::HapticDevice;
use palpate_device::backend::five_dof;
use palpate_device::backend::replay::Replay;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use serde::Serialize;

pub(crate) use choice::DeviceChoice;
pub(crate) use command::{DevicesArguments, run};
pub(crate) use guide::{Guide, Moves};
pub use owned::{OwnedError, Sources};
pub(crate) use owned::{best, placed};

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
            Self::Dhd,
            "a delta, omega or sigma of Force Dimension, or a Novint Falcon, in your hand",
        ),
        (Self::Haply, "a Haply Inverse3 in your hand"),
        (
            Self::OpenHaptics,
            "a Touch or Phantom (OpenHaptics) in your hand",
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
        }
    }

    /// Whether it is a device that somebody owns and holds: there may be none, or several.
    pub(crate) const fn is_owned(self) -> bool {
        matches!(self, Self::Haply | Self::OpenHaptics | Self::Dhd)
    }

    /// The device that is meant: of `auto`, the best that is present and can be moved so.
    pub(crate) fn chosen(self, guide: &Guide) -> Self {
        match (self, &guide.moves) {
            // Whoever gives a script or a motion asks for a hand that is not his own; without a device in it it is the
            // truest one. A device that is plugged in moves only for whoever holds it.
            (Self::Auto, Moves::Script(_)) => Self::Sim,
            (Self::Auto, Moves::Motion(_)) => Self::Replay,
            (Self::Auto, Moves::Held { best, .. }) => *best,
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
}

/// Opens a device that is moved by its guide.
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
    if let Moves::Held { .. } = guide.moves
        && let Some(device) = owned::open(kind, choice.which.as_deref(), sources)?
    {
        return Ok(device);
    }
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
        (owned, Moves::Motion(_)) if owned.is_owned() => {
            return Err(other("your own hand", "no file, or --script", "--motion"));
        }
        (_, Moves::Motion(_) | Moves::Held { .. }) => {
            return Err(other("a script", "--script", "--motion"));
        }
        (_, Moves::Script(_)) => {
            return Err(other("your own hand", "no file, or --script", "--motion"));
        }
    })
}

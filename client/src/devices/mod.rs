//! The devices that this program drives: which there are, opening one, and what is done with one outside of a session.

mod command;
mod plot;

use clap::ValueEnum;
use palpate_device::backend::five_dof;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{HapticDevice, Script};
use serde::Serialize;

pub(crate) use command::{DevicesArguments, run};

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
}

impl DeviceKind {
    /// All that can be opened, with a sentence each; the best first.
    pub const ALL: [(Self, &'static str); 2] = [
        (
            Self::Sim,
            "a simulated hand that follows a script (--script FILE) and feels the force",
        ),
        (
            Self::FiveDof,
            "the 5-DOF device of 2007 with simulated motors and encoders, in the hand of a script (--script FILE)",
        ),
    ];

    /// The word for it on the command line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Sim => "sim",
            Self::FiveDof => "five-dof",
        }
    }

    /// The device that is meant: of `auto`, the best that is present.
    #[must_use]
    pub const fn chosen(self) -> Self {
        match self {
            // Both need no hardware; the hand without a device is the truer one.
            Self::Auto => Self::Sim,
            other => other,
        }
    }
}

/// Why a device can not be opened.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// The script can not be followed with it.
    #[error("the device five-dof can not follow this script: {0}")]
    FiveDof(#[from] five_dof::Unsuited),
}

/// Opens a device that a script moves.
pub(crate) fn open(
    kind: DeviceKind,
    script: &Script,
    start: ScriptStart,
) -> Result<Box<dyn HapticDevice>, DeviceError> {
    Ok(match kind.chosen() {
        DeviceKind::FiveDof => Box::new(five_dof::simulated(script, start)?),
        DeviceKind::Sim | DeviceKind::Auto => Box::new(SimHand::new(script.clone(), start)),
    })
}

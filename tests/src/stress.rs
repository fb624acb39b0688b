//! Busy processes beside a session, as a user's other programs may be.

use std::path::Path;

use crate::program::{Program, ProgramError, die_with_parent};

/// The word that starts the laboratory's program as a busy process; the starting process's number follows it.
pub const ROLE: &str = "busy";

/// The most busy processes of a session.
pub const PROCESSES_MAX: u16 = 64;

/// Turns of the loop between two looks at whether the parent lives: some tens of milliseconds.
const TURNS: u32 = 20_000_000;

/// Processes of ordinary priority that compute without end. Dropping it ends them.
pub struct Stress(Vec<Program>);

impl Stress {
    /// Starts so many.
    pub fn start(executable: &Path, processes: u16) -> Result<Self, ProgramError> {
        let own = std::process::id().to_string();
        let start = |n| Program::start(format!("busy process {n}"), executable, [ROLE, &own]);
        (1..=processes)
            .map(start)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// Refuses when one of them has ended: then the session was not under the stress that it claims.
    pub fn check_alive(&mut self) -> Result<(), ProgramError> {
        self.0.iter_mut().try_for_each(Program::check_alive)
    }
}

/// Is busy on one core until the process of the number `parent` is gone.
pub fn be_busy(parent: Option<u32>) {
    die_with_parent();
    let mut x = 1_u64;
    // The parent may have been gone before the system was asked to end this process with it.
    while parent.is_some() && parent == current_parent() {
        for _ in 0..TURNS {
            x = std::hint::black_box(x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1));
        }
    }
}

#[cfg(unix)]
fn current_parent() -> Option<u32> {
    let parent = rustix::process::getppid()?;
    u32::try_from(parent.as_raw_nonzero().get()).ok()
}

/// Without a way to ask, the process ends when it is killed.
#[cfg(not(unix))]
fn current_parent() -> Option<u32> {
    None
}

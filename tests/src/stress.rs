//! Busy processes beside a session, like other programs of a user.

use std::path::Path;

use crate::program::{Program, ProgramError, die_with_parent};

/// First argument of a busy process; the id of its parent follows.
pub const ROLE: &str = "busy";
pub const PROCESSES_MAX: u16 = 64;

/// Iterations between two checks of the parent: some tens of milliseconds.
const TURNS: u32 = 20_000_000;

/// Busy processes of ordinary priority. Dropping them ends them.
pub struct Stress(Vec<Program>);

impl Stress {
    pub fn start(executable: &Path, processes: u16) -> Result<Self, ProgramError> {
        let own = std::process::id().to_string();
        let start = |n| Program::start(format!("busy process {n}"), executable, [ROLE, &own]);
        (1..=processes)
            .map(start)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// Returns an error if one of them has ended: the session was then not under the claimed stress.
    pub fn check_alive(&mut self) -> Result<(), ProgramError> {
        self.0.iter_mut().try_for_each(Program::check_alive)
    }
}

/// Keeps one core busy until the process `parent` has ended.
pub fn be_busy(parent: Option<u32>) {
    die_with_parent();
    let mut x = 1_u64;
    // The parent may have ended before the death signal was set.
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

/// Without a check of the parent, the process runs until it is killed.
#[cfg(not(unix))]
fn current_parent() -> Option<u32> {
    None
}

//! Removes the join link from the command line, which every user of a machine can read in the list of processes.
//!
//! A program cannot change its command line, but it can start again in the same process with another one. The link moves
//! to the environment, which only the same user can read. Standard input and output, the terminal and the process number
//! remain. The program starts no children that could inherit the variable.

use std::ffi::{OsStr, OsString};

/// The arguments without the first one that is `link`; `None` if there is none.
#[cfg(any(unix, test))]
fn without(mut arguments: Vec<OsString>, link: &str) -> Option<Vec<OsString>> {
    let at = arguments.iter().position(|word| word == OsStr::new(link))?;
    arguments.remove(at);
    Some(arguments)
}

/// Starts the program again without the link in its command line. Returns if that fails, with a hint on standard error,
/// and if the command line of this process has no such link, because a library passed it.
#[cfg(unix)]
pub(super) fn hide(link: &str) {
    use std::os::unix::process::CommandExt as _;
    use std::process::Command;

    let mut words = std::env::args_os();
    let name = words.next();
    let Some(arguments) = without(words.collect(), link) else {
        return;
    };
    let started = std::env::current_exe().map(|program| {
        let mut command = Command::new(program);
        if let Some(name) = name {
            command.arg0(name);
        }
        command
            .args(arguments)
            .env(super::LINK_VARIABLE, link)
            .exec()
    });
    let (Ok(error) | Err(error)) = started;
    super::complain(&format!(
        "hint: the join link stays visible in the list of processes ({error}); give it with --link-file FILE instead"
    ));
}

/// Only the same user and administrators can read the command line of a process.
#[cfg(not(unix))]
pub(super) fn hide(_: &str) {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_link_is_removed() {
        let words = |line: &str| line.split(' ').map(OsString::from).collect::<Vec<_>>();
        let found = without(words("client join palpate://a --name Ada"), "palpate://a");
        assert_eq!(found, Some(words("client join --name Ada")));
        assert_eq!(
            without(words("client join --name Ada"), "palpate://a"),
            None
        );
    }
}

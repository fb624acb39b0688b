//! The join link of a run: an argument, a line of standard input, a file or an environment variable.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use palpate_protocol::link::SCHEME;

use super::command_line;

/// The environment variable with the join link. Only the same user can read the environment of a process.
pub const LINK_VARIABLE: &str = "PALPATE_LINK";

/// Maximum length of the line with the link, bytes: four times the longest link.
const LINE_BYTES_MAX: u64 = 2048;

/// Where the link comes from.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct LinkArguments {
    /// The join link printed by the server; quote it. - reads it from standard input. Without LINK and --link-file it
    /// is taken from the environment variable `PALPATE_LINK`. A link is a secret: LINK is soon removed from the list
    /// of processes, but stays in the history of the shell
    link: Option<String>,
    /// Read the join link from the first line of this file
    #[arg(long, value_name = "FILE")]
    link_file: Option<PathBuf>,
}

/// No join link can be read.
#[derive(Debug, thiserror::Error)]
pub enum LinkSourceError {
    /// No source.
    #[error(
        "no join link is given; give the link that the server printed in one of four ways: `join 'palpate://...'`, \
         `join --link-file FILE`, `join -` (a line of standard input), or the environment variable {LINK_VARIABLE}"
    )]
    Absent,
    /// More than one source.
    #[error("the join link is given twice, by {0} and by {1}; remove one of them")]
    Twice(String, String),
    /// The source is not readable.
    #[error("cannot read the join link from {from}: {source}; check its path and permissions")]
    Unreadable {
        /// The source.
        from: String,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The first line is empty.
    #[error(
        "there is no join link in {0}: its first line is empty; write the link that the server printed there"
    )]
    Empty(String),
}

/// One source of a link.
#[derive(Debug, PartialEq)]
enum Source {
    Argument(String),
    Stdin,
    File(PathBuf),
    Environment(String),
}

impl Source {
    fn describe(&self) -> String {
        match self {
            Self::Argument(_) => "the argument LINK".to_owned(),
            Self::Stdin => "standard input (-)".to_owned(),
            Self::File(path) => format!("the file {} (--link-file)", path.display()),
            Self::Environment(_) => format!("the environment variable {LINK_VARIABLE}"),
        }
    }
}

impl LinkArguments {
    /// Takes a link from the word after an option whose value may be left out (`join --view LINK`), and returns any
    /// other word.
    pub(super) fn take_from(
        &mut self,
        option: &str,
        word: String,
    ) -> Result<Option<String>, LinkSourceError> {
        if !word.starts_with(SCHEME) {
            return Ok(Some(word));
        }
        match self.link.replace(word) {
            None => Ok(None),
            Some(_) => Err(LinkSourceError::Twice(
                "the argument LINK".to_owned(),
                format!("the word after {option}"),
            )),
        }
    }

    /// Reads the link from its only source. A link that was an argument is removed from the command line, for which
    /// the program may start again in this process.
    pub(super) fn read(self) -> Result<String, LinkSourceError> {
        let source = self.source(std::env::var_os(LINK_VARIABLE))?;
        let from = source.describe();
        let line = match source {
            Source::Argument(link) => {
                command_line::hide(&link);
                return Ok(link);
            }
            Source::Environment(link) => return Ok(link),
            Source::Stdin => first_line(io::stdin().lock()),
            Source::File(path) => File::open(&path).and_then(|file| {
                warn_of_readers(&file, &path);
                first_line(BufReader::new(file))
            }),
        };
        match line {
            Ok(line) if line.is_empty() => Err(LinkSourceError::Empty(from)),
            Ok(line) => Ok(line),
            Err(source) => Err(LinkSourceError::Unreadable { from, source }),
        }
    }

    /// The only source. An empty variable counts as absent.
    fn source(self, variable: Option<OsString>) -> Result<Source, LinkSourceError> {
        let argument = self.link.map(|link| match link.as_str() {
            "-" => Source::Stdin,
            _ => Source::Argument(link),
        });
        let file = self.link_file.map(Source::File);
        let variable = variable
            .map(|link| link.to_string_lossy().into_owned())
            .filter(|link| !link.is_empty())
            .map(Source::Environment);
        let mut given = [argument, file, variable].into_iter().flatten();
        let first = given.next().ok_or(LinkSourceError::Absent)?;
        match given.next() {
            None => Ok(first),
            Some(second) => Err(LinkSourceError::Twice(first.describe(), second.describe())),
        }
    }
}

fn first_line(input: impl BufRead) -> io::Result<String> {
    let mut line = String::new();
    input.take(LINE_BYTES_MAX).read_line(&mut line)?;
    Ok(line.trim().to_owned())
}

/// Prints a hint if other users can read the file.
#[cfg(unix)]
fn warn_of_readers(file: &File, path: &Path) {
    use std::os::unix::fs::PermissionsExt as _;

    /// Read permission of group and others.
    const READABLE: u32 = 0o044;
    let is_readable = |m: std::fs::Metadata| m.permissions().mode() & READABLE != 0;
    if file.metadata().is_ok_and(is_readable) {
        let path = path.display();
        super::complain(&format!(
            "hint: other users can read the join link in {path}; `chmod 600 {path}` prevents it"
        ));
    }
}

#[cfg(not(unix))]
fn warn_of_readers(_: &File, _: &Path) {}

#[cfg(test)]
mod tests {
    use super::*;

    fn arguments(link: Option<&str>, file: Option<&str>) -> LinkArguments {
        LinkArguments {
            link: link.map(str::to_owned),
            link_file: file.map(PathBuf::from),
        }
    }

    #[test]
    fn exactly_one_source_is_accepted() {
        let links = [None, Some("palpate://a"), Some("-")];
        let files = [None, Some("link.txt")];
        let variables = [None, Some(""), Some("palpate://v")];
        for link in links {
            for file in files {
                for variable in variables {
                    let sources = usize::from(link.is_some())
                        + usize::from(file.is_some())
                        + usize::from(variable.is_some_and(|v| !v.is_empty()));
                    let found = arguments(link, file).source(variable.map(OsString::from));
                    match sources {
                        0 => assert!(matches!(found, Err(LinkSourceError::Absent))),
                        1 => assert!(found.is_ok(), "{found:?}"),
                        _ => assert!(matches!(found, Err(LinkSourceError::Twice(..)))),
                    }
                }
            }
        }
    }

    #[test]
    fn absent_link_names_all_four_ways() {
        let error = arguments(None, None).source(None).unwrap_err().to_string();
        for way in ["palpate://", "--link-file", "join -", LINK_VARIABLE] {
            assert!(error.contains(way), "{way}: {error}");
        }
    }

    #[test]
    fn no_error_of_two_sources_shows_a_link() {
        let two = arguments(Some("palpate://a"), None).source(Some("palpate://v".into()));
        let error = two.unwrap_err().to_string();
        assert!(
            error.contains("LINK") && error.contains(LINK_VARIABLE),
            "{error}"
        );
        assert!(!error.contains("palpate://"), "{error}");
    }

    #[test]
    fn link_after_an_option_without_value_is_the_link() {
        let take = |link, word: &str| {
            let mut arguments = arguments(link, None);
            let rest = arguments.take_from("--view", word.to_owned());
            (rest, arguments.link)
        };
        let (rest, link) = take(None, "palpate://a");
        assert_eq!(
            (rest.unwrap(), link.as_deref()),
            (None, Some("palpate://a"))
        );
        let (rest, link) = take(Some("-"), "4481");
        assert_eq!(
            (rest.unwrap().as_deref(), link.as_deref()),
            (Some("4481"), Some("-"))
        );
        let error = take(Some("palpate://a"), "palpate://b")
            .0
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("--view") && !error.contains("palpate://"),
            "{error}"
        );
    }

    #[test]
    fn only_the_first_line_is_read_and_its_length_is_bounded() {
        assert_eq!(
            first_line(&b" palpate://a \r\nmore"[..]).unwrap(),
            "palpate://a"
        );
        assert_eq!(first_line(&b""[..]).unwrap(), "");
        let endless = BufReader::new(io::repeat(b'x'));
        assert_eq!(first_line(endless).unwrap().len() as u64, LINE_BYTES_MAX);
    }
}

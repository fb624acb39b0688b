//! A program of this project as a child process with a bounded life.
//!
//! Two threads drain its output, so that it never blocks: every line of standard output, and the first and last
//! lines of standard error for error messages. Dropping a [`Program`] kills the process. If the laboratory is
//! killed, the operating system ends the child (see [`die_with_parent`]).

use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::de::DeserializeOwned;

/// Kept last lines of standard error: an error message and the beginning of a backtrace.
const TAIL_LINES_MAX: usize = 12;

/// Kept first lines of standard error: the startup messages.
const HEAD_LINES_MAX: usize = 24;

/// Maximum length of a kept line, in characters; longer lines are truncated.
const LINE_CHARS_MAX: usize = 400;

/// Poll interval for the exit status.
const POLL: Duration = Duration::from_millis(10);

/// Failure of a child process.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// The operating system did not start it.
    #[error("the {name} could not be started: {source}")]
    Start {
        ///
        /// The program.
        name: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// It ended early.
    #[error("the {name} ended early ({status}){}", said(.tail))]
    Died {
        /// The program.
        name: String,
        /// Exit status.
        status: String,
        /// Its last lines on standard error.
        tail: String,
    },
    /// Timeout.
    #[error("the {name} did not {what} within {seconds:.0} s{}", said(.tail))]
    Late {
        /// The program.
        name: String,
        /// Expected action.
        what: &'static str,
        /// Timeout, s.
        seconds: f64,
        /// Its last lines on standard error.
        tail: String,
    },
    /// Unexpected output.
    #[error("the {name} wrote \"{line}\" where {what} was expected ({error})")]
    Output {
        /// The program.
        name: String,
        /// Expected output.
        what: &'static str,
        /// Received line.
        line: String,
        /// Parse error.
        error: String,
    },
}

fn said(tail: &str) -> String {
    if tail.is_empty() {
        "; its standard error is empty".to_owned()
    } else {
        format!("; its last output:\n    {}", tail.replace('\n', "\n    "))
    }
}

/// A running program.
pub struct Program {
    name: String,
    child: Child,
    stdout: Receiver<String>,
    /// The last line read from `stdout`.
    last: Option<String>,
    said: Arc<Mutex<Said>>,
}

/// Kept lines of standard error.
#[derive(Default)]
struct Said {
    head: Vec<String>,
    tail: VecDeque<String>,
}

impl Said {
    fn push(&mut self, line: &str) {
        let line: String = line.chars().take(LINE_CHARS_MAX).collect();
        if self.head.len() < HEAD_LINES_MAX {
            self.head.push(line.clone());
        }
        if self.tail.len() == TAIL_LINES_MAX {
            self.tail.pop_front();
        }
        self.tail.push_back(line);
    }
}

fn lock(said: &Mutex<Said>) -> MutexGuard<'_, Said> {
    // A panicked reader leaves complete lines behind.
    said.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Program {
    /// Starts `executable` with `arguments`. `name` is what errors call it.
    pub fn start<A: Into<OsString>>(
        name: impl Into<String>,
        executable: &Path,
        arguments: impl IntoIterator<Item = A>,
    ) -> Result<Self, ProgramError> {
        let name = name.into();
        let spawned = Command::new(executable)
            .args(arguments.into_iter().map(Into::into))
            // A link of the user is not for clients of the laboratory.
            .env_remove(palpate_client::LINK_VARIABLE)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let mut child = match spawned {
            Ok(child) => child,
            Err(source) => return Err(ProgramError::Start { name, source }),
        };
        let (sender, stdout) = channel();
        let said = Arc::new(Mutex::new(Said::default()));
        if let Some(out) = child.stdout.take() {
            std::thread::spawn(move || each_line(out, |line| sender.send(line).is_ok()));
        }
        if let Some(err) = child.stderr.take() {
            let said = Arc::clone(&said);
            std::thread::spawn(move || {
                each_line(err, |line| {
                    lock(&said).push(&line);
                    true
                });
            });
        }
        Ok(Self {
            name,
            child,
            stdout,
            last: None,
            said,
        })
    }

    /// Its name in errors.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The next line of its standard output.
    pub fn line(&mut self, what: &'static str, within: Duration) -> Result<String, ProgramError> {
        match self.stdout.recv_timeout(within) {
            Ok(line) => {
                self.last = Some(line.clone());
                Ok(line)
            }
            Err(RecvTimeoutError::Timeout) => Err(self.late(what, within)),
            Err(RecvTimeoutError::Disconnected) => {
                let status = self.child.wait().map_or_else(|e| e.to_string(), describe);
                Err(self.died(status))
            }
        }
    }

    /// The next line of its standard output, which is one JSON object.
    pub fn json<T: DeserializeOwned>(
        &mut self,
        what: &'static str,
        within: Duration,
    ) -> Result<T, ProgramError> {
        let line = self.line(what, within)?;
        self.parse(what, &line)
    }

    /// The last line of its standard output, which is one JSON object, after it ended.
    pub fn last_json<T: DeserializeOwned>(
        &mut self,
        what: &'static str,
    ) -> Result<T, ProgramError> {
        // The reader ends with the pipe, and this loop with the reader.
        while let Ok(line) = self.stdout.recv_timeout(Duration::from_secs(5)) {
            self.last = Some(line);
        }
        let line = self.last.clone().unwrap_or_default();
        self.parse(what, &line)
    }

    fn parse<T: DeserializeOwned>(
        &self,
        what: &'static str,
        line: &str,
    ) -> Result<T, ProgramError> {
        serde_json::from_str(line).map_err(|e| ProgramError::Output {
            name: self.name.clone(),
            what,
            error: e.to_string(),
            line: line.chars().take(LINE_CHARS_MAX).collect(),
        })
    }

    /// Returns an error if the program has ended.
    pub fn check_alive(&mut self) -> Result<(), ProgramError> {
        match self.child.try_wait() {
            Ok(None) => Ok(()),
            Ok(Some(status)) => Err(self.died(describe(status))),
            Err(error) => Err(self.died(error.to_string())),
        }
    }

    /// Requests termination (SIGTERM).
    pub fn ask_to_end(&self) {
        #[cfg(unix)]
        self.signal(rustix::process::Signal::TERM);
    }

    /// Stops the process (SIGSTOP) until [`go_on`](Self::go_on).
    #[cfg(unix)]
    pub fn stand_still(&self) {
        self.signal(rustix::process::Signal::STOP);
    }

    /// Continues it after [`stand_still`](Self::stand_still).
    #[cfg(unix)]
    pub fn go_on(&self) {
        self.signal(rustix::process::Signal::CONT);
    }

    #[cfg(unix)]
    fn signal(&self, signal: rustix::process::Signal) {
        if let Ok(id) = i32::try_from(self.child.id())
            && let Some(pid) = rustix::process::Pid::from_raw(id)
        {
            // The process may have ended already.
            let _ = rustix::process::kill_process(pid, signal);
        }
    }

    /// Kills it (SIGKILL).
    pub fn kill(&mut self) {
        // Both calls fail only if the process has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Waits until it ends.
    pub fn wait(&mut self, within: Duration) -> Result<ExitStatus, ProgramError> {
        let until = Instant::now() + within;
        loop {
            match self.child.try_wait() {
                Ok(Some(status)) => return Ok(status),
                Ok(None) if Instant::now() >= until => return Err(self.late("end", within)),
                Ok(None) => std::thread::sleep(POLL),
                Err(error) => return Err(self.died(error.to_string())),
            }
        }
    }

    /// Waits until it ends; an exit code other than 0 is an error.
    pub fn wait_for_success(&mut self, within: Duration) -> Result<(), ProgramError> {
        let status = self.wait(within)?;
        if status.success() {
            Ok(())
        } else {
            Err(self.died(describe(status)))
        }
    }

    /// Its last lines on standard error.
    pub fn tail(&self) -> String {
        let said = lock(&self.said);
        said.tail.iter().cloned().collect::<Vec<_>>().join("\n")
    }

    /// Whether a phrase occurs in its first or last lines on standard error.
    pub fn has_said(&self, phrase: &str) -> bool {
        let said = lock(&self.said);
        said.head
            .iter()
            .chain(&said.tail)
            .any(|l| l.contains(phrase))
    }

    /// The rest of the first line on standard error that contains a phrase, among its first and last lines.
    pub fn said_after(&self, phrase: &str) -> Option<String> {
        let said = lock(&self.said);
        let mut lines = said.head.iter().chain(&said.tail);
        lines.find_map(|l| Some(l.split_once(phrase)?.1.to_owned()))
    }

    pub(crate) fn late(&self, what: &'static str, within: Duration) -> ProgramError {
        ProgramError::Late {
            name: self.name.clone(),
            what,
            seconds: within.as_secs_f64(),
            tail: self.tail(),
        }
    }

    fn died(&self, status: String) -> ProgramError {
        // Its last output may still be in the pipe.
        std::thread::sleep(5 * POLL);
        ProgramError::Died {
            name: self.name.clone(),
            status,
            tail: self.tail(),
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.kill();
    }
}

fn describe(status: ExitStatus) -> String {
    status.to_string()
}

/// Reads lines until the end or until `take` returns `false`. A status line that is rewritten in place ends
/// with a carriage return.
fn each_line(input: impl Read, mut take: impl FnMut(String) -> bool) {
    let mut input = BufReader::new(input);
    let mut line = Vec::new();
    loop {
        let chunk = match input.fill_buf() {
            Ok([]) | Err(_) => break,
            Ok(chunk) => chunk.to_owned(),
        };
        input.consume(chunk.len());
        for byte in chunk {
            if byte != b'\n' && byte != b'\r' {
                line.push(byte);
            } else if !line.is_empty() {
                let text = String::from_utf8_lossy(&line).into_owned();
                line.clear();
                if !take(text) {
                    return;
                }
            }
        }
    }
    if !line.is_empty() {
        take(String::from_utf8_lossy(&line).into_owned());
    }
}

/// Ends this process when its parent ends. The roles that the laboratory starts call it first.
pub fn die_with_parent() {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Signal, set_parent_process_death_signal};
        // Without it the process ends with its session or its duration.
        let _ = set_parent_process_death_signal(Some(Signal::TERM));
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::path::Path;
    use std::time::Duration;

    use super::{Program, ProgramError};

    const SOON: Duration = Duration::from_secs(10);

    fn shell(script: &str) -> Program {
        Program::start("shell", Path::new("/bin/sh"), ["-c", script]).unwrap()
    }

    #[test]
    fn early_exit_reports_status_and_last_lines() {
        let mut program = shell("echo all is well; echo the roof is on fire >&2; exit 3");
        assert_eq!(program.line("greet", SOON).unwrap(), "all is well");
        let error = program.line("greet again", SOON).unwrap_err();
        let sentence = error.to_string();
        assert!(matches!(error, ProgramError::Died { .. }));
        assert!(sentence.contains("the roof is on fire"), "{sentence}");
        assert!(sentence.contains('3'), "{sentence}");
    }

    #[test]
    fn silent_program_times_out() {
        let mut program = shell("exec sleep 60");
        let error = program
            .line("speak", Duration::from_millis(50))
            .unwrap_err();
        assert!(error.to_string().contains("did not speak"), "{error}");
    }

    #[test]
    fn last_json_returns_last_line() {
        let mut program = shell("echo 1; echo 2; echo '{\"a\": 3}'");
        program.wait_for_success(SOON).unwrap();
        let last: serde_json::Value = program.last_json("a number").unwrap();
        assert_eq!(last["a"], 3);
    }

    #[test]
    fn stopped_program_prints_only_after_it_continues() {
        let mut program = shell("echo up; while :; do sleep 0.02; echo tick; done");
        program.line("come up", SOON).unwrap();
        program.stand_still();
        // Drains the lines in flight.
        while program.line("tick", Duration::from_millis(500)).is_ok() {}
        program.go_on();
        assert_eq!(program.line("tick", SOON).unwrap(), "tick");
        program.stand_still();
        let proc_entry = format!("/proc/{}", program.id());
        drop(program);
        assert!(
            !Path::new(&proc_entry).exists(),
            "a stopped process ends too"
        );
    }

    #[test]
    fn dropping_a_program_ends_it() {
        let program = shell("exec sleep 60");
        let proc_entry = format!("/proc/{}", program.id());
        drop(program);
        assert!(!Path::new(&proc_entry).exists());
    }

    #[test]
    fn program_that_handles_sigterm_ends_on_request() {
        let mut program =
            shell("trap 'echo bye; exit 0' TERM; echo up; while :; do sleep 0.05; done");
        program.line("come up", SOON).unwrap();
        program.ask_to_end();
        program.wait_for_success(SOON).unwrap();
        assert_eq!(program.line("leave", SOON).unwrap(), "bye");
    }
}

//! The seat of a run, stored on disk, so that a run after a crash resumes it at once.
//!
//! There is one file per server, role and name. A running client holds a lock on its file, so a second client of the
//! same name can not take its seat. The operating system releases the lock when the program ends. File errors never
//! end the session; the seat is then not kept.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Path, PathBuf};

use palpate_protocol::handshake::{Hello, Resume, Welcome};
use palpate_protocol::{JoinLink, OperationId, ParticipantId, ResumeToken, TopologyHash};
use palpate_transport::state::{make_private_folder, open_private};
use serde::{Deserialize, Serialize};

/// Format identifier of the file.
const FORMAT: &str = "palpate-seat/1";

/// Maximum file size, bytes. A larger file was not written by this program.
const BYTES_MAX: u64 = 4096;

/// Content of the file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    format: String,
    participant: ParticipantId,
    token: ResumeToken,
    /// Number of runs in this seat before the current one.
    run: u8,
}

/// A stored seat, locked for this run.
pub(crate) struct SeatFile {
    path: PathBuf,
    file: File,
    kept: Option<Kept>,
}

impl SeatFile {
    /// Locks the file of a seat. `None` if another program holds it, or if it can not be written.
    pub(crate) fn open(state: &Path, link: &JoinLink, hello: &Hello) -> Option<Self> {
        let folder = state.join("seats");
        let path = folder.join(file_name(link, hello));
        let opened = make_private_folder(&folder).and_then(|()| Self::lock(path.clone()));
        opened
            .inspect_err(|error| {
                tracing::warn!(%error, path = %path.display(), "cannot store the seat on this disk");
            })
            .ok()
    }

    fn lock(path: PathBuf) -> io::Result<Self> {
        let mut file = open_private(&path)?;
        file.try_lock()?;
        let mut text = String::new();
        (&mut file).take(BYTES_MAX).read_to_string(&mut text)?;
        // A file that a crash left incomplete holds no seat.
        let kept = serde_json::from_str::<Kept>(&text).ok();
        Ok(Self {
            path,
            file,
            kept: kept.filter(|kept| kept.format == FORMAT),
        })
    }

    /// Index of this run among those in the same seat.
    pub(crate) fn run(&self) -> u8 {
        self.kept.as_ref().map_or(0, |kept| kept.run)
    }

    /// Starts another run in the stored seat, if any, without operations of the log.
    pub(crate) fn begin_run(&mut self) -> Option<Resume> {
        let kept = self.kept.as_mut()?;
        let Some(run) = kept.run.checked_add(1) else {
            self.clear();
            return None;
        };
        kept.run = run;
        let resume = Resume {
            participant: kept.participant,
            token: kept.token,
            next_operation: OperationId(0),
            topology_version: 0,
            topology_hash: TopologyHash(0),
        };
        self.write();
        Some(resume)
    }

    /// Stores the seat of a welcome. A stored one continues its run.
    pub(crate) fn keep(&mut self, welcome: &Welcome) {
        let is_kept = |kept: &Kept| kept.token.matches(&welcome.resume_token);
        if self.kept.as_ref().is_some_and(is_kept) {
            return;
        }
        self.kept = Some(Kept {
            format: FORMAT.to_owned(),
            participant: welcome.participant,
            token: welcome.resume_token,
            run: 0,
        });
        self.write();
    }

    /// Whether the file holds no seat.
    pub(crate) fn is_empty(&self) -> bool {
        self.kept.is_none()
    }

    /// Forgets a released seat, and keeps the lock for the next one.
    pub(crate) fn clear(&mut self) {
        self.kept = None;
        self.write();
    }

    /// Removes the file after the server released the seat.
    pub(crate) fn remove(self) {
        if let Err(error) = std::fs::remove_file(&self.path) {
            tracing::warn!(%error, path = %self.path.display(), "cannot remove the stored seat");
        }
    }

    /// Writes in place, because the lock belongs to this file.
    fn write(&mut self) {
        let text = self
            .kept
            .as_ref()
            .map(|kept| serde_json::to_string(kept).expect("a seat is plain data"));
        let written = self
            .file
            .rewind()
            .and_then(|()| self.file.set_len(0))
            .and_then(|()| self.file.write_all(text.unwrap_or_default().as_bytes()));
        if let Err(error) = written {
            tracing::warn!(%error, path = %self.path.display(), "cannot store the seat");
        }
    }
}

/// A file name that hides the link and has only valid characters.
fn file_name(link: &JoinLink, hello: &Hello) -> String {
    let seat = format!(
        "{}\n{}\n{}\n{}\n{}",
        link.certificate, link.host, link.port, hello.role, hello.name
    );
    format!("{:032x}", xxhash_rust::xxh3::xxh3_128(seat.as_bytes()))
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use palpate_protocol::handshake::Subscription;
    use palpate_protocol::{CertificateHash, Grant, Role};

    use super::*;

    fn seat(state: &Path, name: &str) -> Option<SeatFile> {
        let link = JoinLink {
            host: "127.0.0.1".to_owned(),
            port: 4433,
            role: Role::Trainee,
            certificate: CertificateHash([1; 32]),
            grant: Grant([2; 16]),
        };
        let hello = Hello {
            name: name.to_owned(),
            role: link.role,
            grant: link.grant,
            tool: None,
            subscription: Subscription::Full,
            resume: None,
        };
        SeatFile::open(state, &link, &hello)
    }

    /// Stores a seat as a joining run does.
    fn sit(kept: &mut SeatFile) {
        kept.kept = Some(Kept {
            format: FORMAT.to_owned(),
            participant: ParticipantId(7),
            token: ResumeToken([9; 16]),
            run: 0,
        });
        kept.write();
    }

    #[test]
    fn run_after_crash_resumes_seat_with_new_run_number() {
        let dir = tempfile::tempdir().unwrap();
        let mut first = seat(dir.path(), "ann").unwrap();
        assert!(first.begin_run().is_none());
        sit(&mut first);
        assert!(seat(dir.path(), "ann").is_none(), "its program still runs");
        assert!(seat(dir.path(), "bob").unwrap().begin_run().is_none());
        drop(first);
        for run in 1..4 {
            let mut again = seat(dir.path(), "ann").unwrap();
            let resume = again.begin_run().unwrap();
            assert!(resume.token.matches(&ResumeToken([9; 16])));
            assert_eq!((resume.participant, again.run()), (ParticipantId(7), run));
        }
    }

    #[test]
    fn seat_file_is_private_and_removed_on_leaving() {
        let dir = tempfile::tempdir().unwrap();
        let mut kept = seat(dir.path(), "ann").unwrap();
        sit(&mut kept);
        let path = kept.path.clone();
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        kept.remove();
        assert!(!path.exists());
        assert!(seat(dir.path(), "ann").unwrap().begin_run().is_none());
    }

    #[test]
    fn damaged_file_is_ignored() {
        let dir = tempfile::tempdir().unwrap();
        let mut kept = seat(dir.path(), "ann").unwrap();
        sit(&mut kept);
        let path = kept.path.clone();
        drop(kept);
        std::fs::write(&path, "{\"format\": \"palpate-se").unwrap();
        assert!(seat(dir.path(), "ann").unwrap().begin_run().is_none());
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o644)).unwrap();
        assert!(seat(dir.path(), "ann").is_none());
    }
}

//! A small model with scripts and a session, for tests of whole programs.

// Each test file uses a part of it.
#![allow(dead_code)]

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use palpate_lab::network::Profile;
use palpate_lab::scripts::Scripts;
use palpate_lab::session::{Hosting, Participant, Session};
use palpate_lab::test_model::TestModel;
use palpate_lab::tool_location::ToolLocation;
use palpate_tissue::{Material, Topology, block};

/// The program under test, in all its roles.
pub(crate) fn executable() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_palpate-lab"))
}

/// Serialises sessions, which would compete for the processors.
pub(crate) fn alone() -> MutexGuard<'static, ()> {
    static TABLE: Mutex<()> = Mutex::new(());
    TABLE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A block of soft tissue and a folder for all output.
pub(crate) struct Table {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) subject: TestModel,
}

impl Table {
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let soft = Material {
            name: "soft".into(),
            young_pa: 1e4,
            density_kg_m3: 1000.0,
            friction_static: 0.4,
            friction_dynamic: 0.3,
            source: "test".into(),
            ..Material::default()
        };
        let subject = TestModel::of(block([20, 20, 8], 0.005, &soft, 1), dir.path()).unwrap();
        Self { dir, subject }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Writes the scripts of the holder and the cutter.
    pub(crate) fn scripts(&self, seconds: f64) -> [PathBuf; 2] {
        let place = ToolLocation::find(&Topology::new(self.subject.model.clone())).unwrap();
        let scripts = Scripts::for_location(&place, seconds).unwrap();
        let files = [self.path("holder.toml"), self.path("cutter.toml")];
        std::fs::write(&files[0], scripts.holder.to_toml()).unwrap();
        std::fs::write(&files[1], scripts.cutter.to_toml()).unwrap();
        files
    }

    /// Starts a session on an emulated network.
    pub(crate) fn host(&self, profile: &str, start_when: u16) -> Session {
        Session::start(&Hosting {
            executable: executable(),
            model: &self.subject.file,
            profile: Profile::named(profile).unwrap(),
            seed: 1,
            compensation: "adaptive",
            start_when,
            view: None,
            seats: None,
        })
        .unwrap()
    }

    /// Both trainees, after joining.
    pub(crate) fn trainees(&self, session: &Session, seconds: f64) -> [Participant; 2] {
        let [holder, cutter] = self.scripts(seconds);
        let join = |name, script: &Path| {
            session
                .join(name, "trainee", Some(script), self.dir.path())
                .unwrap()
        };
        let mut both = [join("holder", &holder), join("cutter", &cutter)];
        for participant in &mut both {
            participant.wait_until_in(&|| false).unwrap();
        }
        both
    }
}

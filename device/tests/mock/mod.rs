//! Mocks of makers' libraries: compiled once per test program, and copied for every test, so that each has its own
//! memory.

// Each test program uses a part of it.
#![allow(dead_code)]

use std::path::{Path, PathBuf};
use std::process::Command;

/// A mock that a test controls outside the driver.
pub(crate) struct Mock {
    loaded: libloading::Library,
    folder: tempfile::TempDir,
    name: &'static str,
}

impl Mock {
    /// Compiles `source`, a file beside this one, with flags of its own (`--cfg lacks_buttons`).
    pub(crate) fn compiled(source: &str, name: &'static str, flags: &[&str]) -> Self {
        // In the target's own folder, because the folder of a static is never removed.
        let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let file = folder.path().join(name);
        let source = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/mock")
            .join(source);
        let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
        let mut command = Command::new(rustc);
        command.args([
            "--edition",
            "2021",
            "--crate-type",
            "cdylib",
            "-O",
            "-C",
            "panic=unwind",
        ]);
        let done = command
            .args(flags)
            .arg("-o")
            .arg(&file)
            .arg(&source)
            .output()
            .unwrap();
        assert!(
            done.status.success(),
            "{}",
            String::from_utf8_lossy(&done.stderr)
        );
        Self::load(folder, name)
    }

    /// Another copy with separate memory.
    pub(crate) fn copy(&self) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::copy(self.file(), folder.path().join(self.name)).unwrap();
        Self::load(folder, self.name)
    }

    fn load(folder: tempfile::TempDir, name: &'static str) -> Self {
        // SAFETY: our own library, whose initialisers do nothing.
        let loaded = unsafe { libloading::Library::new(folder.path().join(name)) }.unwrap();
        Self {
            loaded,
            folder,
            name,
        }
    }

    /// Its path.
    pub(crate) fn file(&self) -> PathBuf {
        self.folder.path().join(self.name)
    }

    /// Sets a knob.
    pub(crate) fn set(&self, knob: u32, value: f64) {
        // SAFETY: the type is that of `mock_set` in every stand-in.
        let set = unsafe { self.loaded.get::<extern "C" fn(u32, f64)>("mock_set") }.unwrap();
        set(knob, value);
    }

    /// Reads a gauge.
    pub(crate) fn get(&self, what: u32) -> f64 {
        // SAFETY: the type is that of `mock_get` in every stand-in.
        let get = unsafe { self.loaded.get::<extern "C" fn(u32) -> f64>("mock_get") }.unwrap();
        get(what)
    }

    /// Its log, line by line.
    pub(crate) fn log(&self) -> Vec<String> {
        // SAFETY: the type is that of `mock_log` in every stand-in.
        let log = unsafe {
            self.loaded
                .get::<unsafe extern "C" fn(*mut u8, usize) -> usize>("mock_log")
        };
        let log = log.unwrap();
        let mut bytes = vec![0; 4_100_000];
        // SAFETY: the pointer is valid for as many bytes as it says.
        let n = unsafe { log(bytes.as_mut_ptr(), bytes.len()) };
        bytes.truncate(n);
        let text = String::from_utf8(bytes).unwrap();
        text.lines().map(str::to_owned).collect()
    }
}

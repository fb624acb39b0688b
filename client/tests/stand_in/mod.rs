//! Stand-ins for the libraries of devices that people own.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A stand-in for a maker's library, compiled from the device package's tests.
pub(crate) fn compiled(source: &str, folder: &Path) -> PathBuf {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = folder.join(source).with_extension("so");
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let done = Command::new(rustc)
        .args(["--edition", "2021", "--crate-type", "cdylib", "-O", "-o"])
        .arg(&file)
        .arg(manifest.join("../device/tests/mock").join(source))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{said}");
    file
}

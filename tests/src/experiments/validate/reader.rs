//! Forces of finite elements of other programs, by the scripts in `tests/readers`.

use std::path::Path;
use std::process::Command;

/// The two forces that a script prints for these numbers. `PALPATE_PYTHON` names a Python with its packages, see
/// `tests/tests/readers.rs`; `None` without that variable.
#[allow(clippy::print_stdout)]
pub(super) fn forces_of(script: &str, numbers: &[f64]) -> Option<[f64; 2]> {
    let Some(python) = std::env::var_os("PALPATE_PYTHON") else {
        println!("PALPATE_PYTHON is not set: nothing was tested");
        return None;
    };
    let readers = Path::new(env!("CARGO_MANIFEST_DIR")).join("readers");
    let out = Command::new(&python)
        .arg(readers.join(script))
        .args(numbers.iter().map(f64::to_string))
        .output();
    let out = out.unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{said}");
    Some(serde_json::from_slice(&out.stdout).unwrap())
}

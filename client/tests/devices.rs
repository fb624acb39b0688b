//! `palpate-client devices` as a program, beside stand-ins for the libraries of devices that people own.

#![allow(clippy::unwrap_used)]

mod stand_in;

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use stand_in::compiled;

/// A machine on which nothing but what `libraries` name is installed.
fn devices(arguments: &[&str], libraries: &[(&str, &Path)]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_palpate-client"));
    command
        .arg("devices")
        .args(arguments)
        .env("PALPATE_HAPLY", "ws://127.0.0.1:9")
        .env("PALPATE_LIBHD", "nowhere/libHD.so")
        .env("PALPATE_LIBDRD", "nowhere/libdrd.so");
    for (name, file) in libraries {
        command.env(name, file);
    }
    command.output().unwrap()
}

fn row<'a>(list: &'a Value, device: &str) -> &'a Value {
    let rows = list["devices"].as_array().unwrap();
    rows.iter().find(|r| r["device"] == device).unwrap()
}

#[test]
fn the_list_says_of_each_device_what_is_missing_and_how_to_get_it() {
    let output = devices(&["list", "--json"], &[]);
    assert!(output.status.success());
    let list: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(row(&list, "sim")["present"], true);
    for (device, word) in [
        ("haply", "haply.co"),
        ("openhaptics", "libHD.so"),
        ("dhd", "libdrd.so"),
    ] {
        let row = row(&list, device);
        assert_eq!(row["present"], false);
        assert!(row["why"].as_str().unwrap().contains(word), "{row}");
    }
    let text = String::from_utf8(devices(&[], &[]).stdout).unwrap();
    assert!(text.contains("not here: no Haply service"), "{text}");
}

#[test]
fn what_is_plugged_in_is_listed_tested_and_calibrated() {
    let folder = tempfile::tempdir().unwrap();
    let (drd, hd) = (
        compiled("drd.rs", folder.path()),
        compiled("hd.rs", folder.path()),
    );
    let libraries = [("PALPATE_LIBDRD", drd.as_path()), ("PALPATE_LIBHD", &hd)];
    let output = devices(&["list", "--json"], &libraries);
    let list: Value = serde_json::from_slice(&output.stdout).unwrap();
    let dhd = row(&list, "dhd");
    assert_eq!(
        (&dhd["present"], &dhd["found"][0]["name"]),
        (&Value::from(true), &Value::from("omega.7"))
    );
    assert_eq!(row(&list, "openhaptics")["clock"], "device callback");
    for device in ["dhd", "openhaptics"] {
        // On the real clock: a stand-in is as quick as a device.
        let tested = devices(&["test", device], &libraries);
        let table = String::from_utf8(tested.stdout).unwrap();
        assert!(tested.status.success(), "{table}");
        assert!(table.contains("skipped  a force moves the tool"), "{table}");
        let calibrated = devices(&["calibrate", device], &libraries);
        let said = String::from_utf8(calibrated.stdout).unwrap();
        assert_eq!(said, format!("{device}: calibrated\n"));
    }
    let other = devices(&["test", "dhd:12"], &libraries);
    let said = String::from_utf8(other.stderr).unwrap();
    assert!(
        !other.status.success() && said.contains("dhd:12") && said.contains("omega.7"),
        "{said}"
    );
}

#[test]
fn pointer_is_listed_and_passes_the_suite_without_a_view() {
    let list: Value = serde_json::from_slice(&devices(&["list", "--json"], &[]).stdout).unwrap();
    let row = row(&list, "pointer");
    assert_eq!(row["present"], true);
    assert!(row["is"].as_str().unwrap().contains("--view"), "{row}");
    let tested = devices(&["test", "pointer"], &[]);
    let table = String::from_utf8(tested.stdout).unwrap();
    assert!(tested.status.success(), "{table}");
}

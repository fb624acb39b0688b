//! Project rules that no compiler checks: imports between packages, confined names, file locations, file
//! lengths.
//!
//! Every rule lists all violations at once, with file and line, and the remedy.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cargo_metadata::{Metadata, MetadataCommand};

/// A package may depend only on packages of a lower level.
const LEVELS: [(&str, u8); 12] = [
    ("palpate-device", 0),
    ("palpate-protocol", 0),
    ("palpate-tissue", 0),
    ("palpate-anatomy", 1),
    ("palpate-room", 1),
    ("palpate-haptics", 1),
    ("palpate-site", 2),
    ("palpate-transport", 2),
    ("palpate-view", 3),
    ("palpate-server", 4),
    ("palpate-client", 4),
    ("palpate-lab", 5),
];

/// Allowed top-level entries, besides those that begin with a dot.
const TOP_LEVEL: [&str; 14] = [
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "Cargo.lock",
    "Cargo.toml",
    "LICENSE-APACHE",
    "LICENSE-MIT",
    "README.md",
    "client",
    "deploy",
    "device",
    "protocol",
    "server",
    "tests",
];

/// Output folders of programs, listed in `.gitignore`.
const LEFT_BY_PROGRAMS: [&str; 2] = ["palpate-report", "target"];

/// The fuzzing corpus, which is generated.
const MADE_BY_FUZZERS: &str = "tests/fuzz/corpus";

/// External crates that only some packages may name.
const CONFINED: [(&str, &[&str]); 5] = [
    ("bincode", &["palpate-protocol"]),
    ("quinn", &["palpate-transport"]),
    ("rustls", &["palpate-transport"]),
    ("rcgen", &["palpate-transport"]),
    (
        "tokio",
        &[
            "palpate-transport",
            "palpate-view",
            "palpate-server",
            "palpate-client",
            "palpate-lab",
        ],
    ),
];

/// Path prefixes of code that may read a clock; programs in `examples/` and `benches/` may too.
const SHELLS: [&str; 6] = [
    "server/src/",
    "client/src/",
    "client/tests/",
    "client/view/",
    "protocol/transport/",
    "tests/",
];

/// Maximum lines per file; split a longer one.
const LINES_MAX: usize = 600;

/// Files that grow with the project and are not read sequentially.
const LONG_BY_NATURE: [&str; 3] = ["Cargo.lock", "CHANGELOG.md", "package-lock.json"];

/// The built page and the packages that build it.
const BUILT_PAGE: [&str; 2] = ["client/view/page/dist", "client/view/page/node_modules"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

fn metadata() -> Metadata {
    MetadataCommand::new()
        .manifest_path(root().join("Cargo.toml"))
        .no_deps()
        .exec()
        .unwrap()
}

/// A text file of the project.
struct File {
    /// Path from the top, with forward slashes.
    path: String,
    text: String,
}

impl File {
    fn is_rust(&self) -> bool {
        Path::new(&self.path).extension().is_some_and(|e| e == "rs")
    }

    /// Numbered lines without comments and literals.
    fn code(&self) -> Vec<(usize, String)> {
        let code = without_comments_and_literals(&self.text);
        code.lines()
            .enumerate()
            .map(|(n, line)| (n + 1, line.to_owned()))
            .collect()
    }
}

/// Every text file of the project, sorted by path.
fn files() -> Vec<File> {
    fn walk(dir: &Path, root: &Path, found: &mut Vec<File>) {
        let mut entries: Vec<PathBuf> = std::fs::read_dir(dir)
            .unwrap()
            .map(|e| e.unwrap().path())
            .collect();
        entries.sort();
        for entry in entries {
            let name = entry.file_name().unwrap().to_string_lossy().into_owned();
            let is_top = dir == root;
            if name == ".git" || (is_top && LEFT_BY_PROGRAMS.contains(&name.as_str())) {
                continue;
            }
            if entry == root.join(MADE_BY_FUZZERS)
                || BUILT_PAGE.iter().any(|built| entry == root.join(built))
            {
                continue;
            }
            if entry.is_dir() {
                walk(&entry, root, found);
            } else if let Ok(text) = std::fs::read_to_string(&entry) {
                // A file that is not text (image, model) has no lines.
                let path = entry
                    .strip_prefix(root)
                    .unwrap()
                    .to_string_lossy()
                    .replace('\\', "/");
                found.push(File { path, text });
            }
        }
    }
    let root = root();
    let mut found = Vec::new();
    walk(&root, &root, &mut found);
    assert!(found.len() > 20, "no project files found");
    found
}

/// The package of a file: that of the nearest folder above it.
fn package_of<'a>(path: &str, metadata: &'a Metadata) -> Option<&'a str> {
    let file = root().join(path);
    metadata
        .packages
        .iter()
        .filter(|p| file.starts_with(p.manifest_path.parent().unwrap()))
        .max_by_key(|p| p.manifest_path.as_str().len())
        .map(|p| p.name.as_str())
}

/// Rust text with comments, strings and characters blanked, line breaks kept.
fn without_comments_and_literals(text: &str) -> String {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let mut out = String::with_capacity(text.len());
    let mut i = 0;
    while i < chars.len() {
        let end = match (at(i), at(i + 1)) {
            ('/', '/') => (i..chars.len())
                .find(|&j| at(j) == '\n')
                .unwrap_or(chars.len()),
            ('/', '*') => end_of_block_comment(&chars, i),
            ('r', '"' | '#') if !is_word(at(i.wrapping_sub(1))) => end_of_raw_string(&chars, i),
            ('"', _) => end_of_string(&chars, i),
            // A lifetime has no closing quote two characters on.
            ('\'', '\\') => (i + 3..chars.len())
                .find(|&j| at(j) == '\'')
                .map_or(chars.len(), |j| j + 1),
            ('\'', _) if at(i + 2) == '\'' => i + 3,
            _ => i,
        };
        if end == i {
            out.push(chars[i]);
            i += 1;
        } else {
            let end = end.min(chars.len());
            out.extend(chars[i..end].iter().filter(|c| **c == '\n'));
            out.push(' ');
            i = end;
        }
    }
    out
}

fn end_of_block_comment(chars: &[char], start: usize) -> usize {
    let mut depth = 0;
    let mut i = start;
    while i < chars.len() {
        match (chars[i], chars.get(i + 1)) {
            ('/', Some('*')) => depth += 1,
            ('*', Some('/')) => depth -= 1,
            _ => {
                i += 1;
                continue;
            }
        }
        i += 2;
        if depth == 0 {
            return i;
        }
    }
    i
}

fn end_of_string(chars: &[char], start: usize) -> usize {
    let mut i = start + 1;
    while i < chars.len() && chars[i] != '"' {
        i += if chars[i] == '\\' { 2 } else { 1 };
    }
    i + 1
}

/// The end of `r"..."` or `r#"..."#`; `start` itself for a raw identifier.
fn end_of_raw_string(chars: &[char], start: usize) -> usize {
    let hashes = chars[start + 1..].iter().take_while(|c| **c == '#').count();
    if chars.get(start + 1 + hashes) != Some(&'"') {
        return start;
    }
    let mut i = start + 2 + hashes;
    while i < chars.len() {
        if chars[i] == '"' && chars[i + 1..].iter().take_while(|c| **c == '#').count() >= hashes {
            return i + 1 + hashes;
        }
        i += 1;
    }
    i
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Whether `line` contains `name` as whole words.
fn names(line: &str, name: &str) -> bool {
    line.match_indices(name).any(|(at, _)| {
        let before = line[..at].chars().next_back().is_some_and(is_word);
        let after = line[at + name.len()..].chars().next().is_some_and(is_word);
        !before && !after
    })
}

fn refuse(offenders: &[String], what_to_do: &str) {
    /// Maximum violations printed at once.
    const SHOWN_MAX: usize = 50;
    let shown = &offenders[..offenders.len().min(SHOWN_MAX)];
    let more = offenders.len() - shown.len();
    assert!(
        shown.is_empty(),
        "{what_to_do}\n  {}\n  and {more} more",
        shown.join("\n  ")
    );
}

#[test]
fn packages_depend_on_lower_levels_only() {
    let levels = BTreeMap::from(LEVELS);
    let mut offenders = Vec::new();
    for package in &metadata().packages {
        let Some(level) = levels.get(package.name.as_str()) else {
            offenders.push(format!("{} has no level", package.name));
            continue;
        };
        for dependency in package.dependencies.iter().filter(|d| d.path.is_some()) {
            match levels.get(dependency.name.as_str()) {
                Some(below) if below < level => {}
                Some(other) => offenders.push(format!(
                    "{} (level {level}) depends on {} (level {other})",
                    package.name, dependency.name
                )),
                None => offenders.push(format!("{} has no level", dependency.name)),
            }
        }
    }
    refuse(
        &offenders,
        "A package may import only from a lower level (ARCHITECTURE.md):",
    );
}

#[test]
fn client_depends_on_no_mesh_generation() {
    let metadata = metadata();
    let is_client = |name: &str| ["palpate-client", "palpate-site"].contains(&name);
    let packages = metadata.packages.iter().filter(|p| is_client(&p.name));
    let offenders: Vec<String> = packages
        .flat_map(|p| p.dependencies.iter().map(move |d| (&p.name, &d.name)))
        .filter(|(_, d)| *d == "palpate-anatomy")
        .map(|(p, d)| format!("{p} depends on {d}"))
        .collect();
    refuse(&offenders, "A client loads model files and builds none:");
}

#[test]
fn every_level_names_a_package() {
    let metadata = metadata();
    let missing: Vec<String> = LEVELS
        .iter()
        .filter(|(name, _)| !metadata.packages.iter().any(|p| p.name.as_str() == *name))
        .map(|(name, _)| (*name).to_owned())
        .collect();
    refuse(
        &missing,
        "These packages have a level and are not in the workspace:",
    );
}

#[test]
fn top_level_has_only_allowed_entries() {
    let offenders: Vec<String> = std::fs::read_dir(root())
        .unwrap()
        .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
        .filter(|name| {
            let is_agreed = name.starts_with('.')
                || TOP_LEVEL.contains(&name.as_str())
                || LEFT_BY_PROGRAMS.contains(&name.as_str())
                || Path::new(name).extension().is_some_and(|e| e == "palp");
            !is_agreed
        })
        .collect();
    refuse(
        &offenders,
        "These do not belong at the top; move them into a package's folder:",
    );
}

#[test]
fn only_allowed_packages_depend_on_confined_crates() {
    let mut offenders = Vec::new();
    for package in &metadata().packages {
        for dependency in &package.dependencies {
            let name = dependency.name.split('-').next().unwrap_or_default();
            let confined = CONFINED.iter().find(|(c, _)| *c == name);
            if confined.is_some_and(|(_, to)| !to.contains(&package.name.as_str())) {
                offenders.push(format!("{} depends on {}", package.name, dependency.name));
            }
        }
    }
    refuse(
        &offenders,
        "These crates stand behind one package each; go through it:",
    );
}

#[test]
fn only_allowed_packages_name_confined_crates() {
    let metadata = metadata();
    let mut offenders = Vec::new();
    for file in files().iter().filter(|f| f.is_rust()) {
        let package = package_of(&file.path, &metadata).unwrap_or_default();
        for (line, code) in file.code() {
            for (name, allowed) in CONFINED {
                let is_allowed = allowed.contains(&package)
                    && (name != "bincode" || file.path.ends_with("/codec.rs"));
                if names(&code, name) && !is_allowed {
                    offenders.push(format!("{}:{line} names {name}", file.path));
                }
            }
        }
    }
    refuse(
        &offenders,
        "bincode stands behind codec.rs of the protocol; quinn, rustls and rcgen behind the \
         transport; tokio is for the transport and the programs:",
    );
}

#[test]
fn unsafe_code_is_limited_to_system_interfaces() {
    let is_allowed = |file: &File| {
        let parts: Vec<&str> = file.path.split('/').collect();
        let is_driver = matches!(parts[..], ["device", "src", "backend", _, "sys.rs"]);
        // A counting allocator requires unsafe code.
        let is_test_allocator = parts.contains(&"tests")
            && names(&without_comments_and_literals(&file.text), "GlobalAlloc");
        // A mock of a vendor library exports C functions, which its test calls directly.
        let is_stand_in = file.path.starts_with("device/tests/mock/");
        is_driver
            || is_stand_in
            || file.path == "protocol/transport/src/threads/sys.rs"
            || is_test_allocator
    };
    let mut offenders = Vec::new();
    for file in files().iter().filter(|f| f.is_rust() && !is_allowed(f)) {
        for (line, code) in file.code() {
            if names(&code, "unsafe") {
                offenders.push(format!("{}:{line}", file.path));
            }
        }
    }
    refuse(
        &offenders,
        "unsafe is for device/src/backend/*/sys.rs, protocol/transport/src/threads/sys.rs, and in tests for counting \
         allocators and device/tests/mock/:",
    );
}

#[test]
fn only_shells_read_a_clock() {
    let is_shell = |path: &str| {
        SHELLS.iter().any(|s| path.starts_with(s))
            || path
                .split('/')
                .any(|part| part == "examples" || part == "benches")
    };
    let mut offenders = Vec::new();
    for file in files().iter().filter(|f| f.is_rust() && !is_shell(&f.path)) {
        for (line, code) in file.code() {
            let sleeps = code.replace(' ', "").contains("sleep(") && names(&code, "sleep");
            if names(&code, "Instant::now") || names(&code, "SystemTime::now") || sleeps {
                offenders.push(format!("{}:{line}", file.path));
            }
        }
    }
    refuse(
        &offenders,
        "Time is an argument; only shells read a clock or sleep:",
    );
}

#[test]
fn no_file_names_a_path_outside_the_project() {
    // Assembled here, so that this file does not violate the rule.
    let absolute: Vec<String> = ["home", "root", "work", "Users"]
        .iter()
        .map(|name| ["/", name, "/"].concat())
        .collect();
    let data = ["shared", "data"].join("/");
    let explains_data =
        |path: &str| path == ".ci/run" || Path::new(path).extension().is_some_and(|e| e == "md");
    let begins_a_path = |text: &str, at: usize| {
        let before = text[..at].chars().next_back();
        !before.is_some_and(|c| is_word(c) || "./-}~*".contains(c))
    };
    let mut offenders = Vec::new();
    for file in files() {
        for (n, line) in file.text.lines().enumerate() {
            let is_outside = absolute
                .iter()
                .flat_map(|name| line.match_indices(name.as_str()))
                .any(|(at, _)| begins_a_path(line, at));
            let names_data = line
                .match_indices(&data)
                .any(|(at, _)| !(explains_data(&file.path) && line[..at].ends_with("../")));
            if is_outside || names_data {
                let excerpt: String = line.trim().chars().take(80).collect();
                offenders.push(format!("{}:{}: {excerpt}", file.path, n + 1));
            }
        }
    }
    refuse(
        &offenders,
        "The project speaks of itself alone; a path outside it belongs in a variable such as \
         PALPATE_DATA:",
    );
}

#[test]
fn files_have_a_maximum_length() {
    let offenders: Vec<String> = files()
        .iter()
        .filter(|f| !LONG_BY_NATURE.iter().any(|name| f.path.ends_with(name)))
        .map(|f| (f.text.lines().count(), &f.path))
        .filter(|(lines, _)| *lines > LINES_MAX)
        .map(|(lines, path)| format!("{path}: {lines} lines"))
        .collect();
    refuse(
        &offenders,
        &format!("At most {LINES_MAX} lines; split these files:"),
    );
}

#[test]
fn every_crate_root_has_documentation() {
    let mut offenders = Vec::new();
    for package in &metadata().packages {
        for target in &package.targets {
            let text = std::fs::read_to_string(&target.src_path).unwrap();
            if !text.starts_with("//!") {
                offenders.push(target.src_path.to_string());
            }
        }
    }
    refuse(
        &offenders,
        "A crate root begins with //! documentation of its scope:",
    );
}

#[test]
fn comments_and_literals_are_not_code() {
    let text = "let a = \"tokio \\\" // x\"; // tokio\n/* tokio /* tokio */ */ fn f<'a>(c: char) {\n\
                r#\"tokio \" \"# ; '\"'; '\\''; b\"tokio\"; r#type; tokio_like; real::tokio!()}";
    let code = without_comments_and_literals(text);
    assert_eq!(code.lines().count(), 3);
    let found: Vec<usize> = code
        .lines()
        .enumerate()
        .filter(|(_, l)| names(l, "tokio"))
        .map(|(n, _)| n)
        .collect();
    assert_eq!(found, [2], "{code}");
    assert!(
        code.contains("r#type") && code.contains("fn f<'a>(c: char)"),
        "{code}"
    );
}

//! The strokes file: paths of a blade over the surface of a model, as TOML.

use std::io::Read as _;
use std::path::Path;

use serde::Deserialize;

use crate::ServerError;

/// Format of a strokes file; a file may name it.
const FORMAT: &str = "palpate-strokes/1";
/// Largest strokes file in bytes, some two million points. A larger file is rejected.
const FILE_BYTES_MAX: u64 = 128 << 20;
/// Most strokes of a file. Every stroke changes the topology, so further ones belong into a second run.
const STROKES_MAX: usize = 100_000;

/// A strokes file.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct StrokesFile {
    format: Option<String>,
    #[serde(default)]
    stroke: Vec<StrokeEntry>,
}

/// One stroke as it is written.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StrokeEntry {
    /// The path of the blade's upper end over the surface.
    pub(super) points_mm: Vec<[f64; 3]>,
    pub(super) depth_mm: Depth,
    /// Width of the wound at its top.
    #[serde(default)]
    pub(super) width_mm: f64,
    /// Direction of the depth, of any length; default: the inward normal at each point.
    pub(super) direction: Option<[f64; 3]>,
}

/// Depth of the blade below its points.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a depth in mm, or a list with one depth per point"
)]
pub(super) enum Depth {
    /// The same at all points.
    Same(f64),
    /// One per point.
    Each(Vec<f64>),
}

/// Reads a strokes file. Impossible strokes are valid here; applying them gives the reason of their refusal.
pub(super) fn read(path: &Path) -> Result<Vec<StrokeEntry>, ServerError> {
    let wrong = |why: String| ServerError::Option(format!("{}: {why}", path.display()));
    let mut text = String::new();
    let file = std::fs::File::open(path);
    let read = file.and_then(|f| f.take(FILE_BYTES_MAX + 1).read_to_string(&mut text));
    read.map_err(|e| wrong(format!("the strokes file can not be read: {e}")))?;
    if text.len() as u64 > FILE_BYTES_MAX {
        return Err(wrong(format!(
            "the strokes file is larger than {FILE_BYTES_MAX} bytes; divide it"
        )));
    }
    let file: StrokesFile = toml::from_str(&text).map_err(|e| {
        wrong(format!(
            "invalid strokes file: {e}`palpate-server cut --help` shows an example"
        ))
    })?;
    if let Some(other) = file.format.filter(|f| f != FORMAT) {
        return Err(wrong(format!(
            "unknown format \"{other}\"; this program reads \"{FORMAT}\""
        )));
    }
    match file.stroke.len() {
        0 => Err(wrong(
            "the file has no stroke; add a [[stroke]] with points_mm and depth_mm".to_owned(),
        )),
        1..=STROKES_MAX => Ok(file.stroke),
        count => Err(wrong(format!(
            "the file has {count} strokes; at most {STROKES_MAX} are possible, divide it"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Vec<StrokeEntry>, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("strokes.toml");
        std::fs::write(&path, text).unwrap();
        read(&path).map_err(|e| e.to_string())
    }

    #[test]
    fn whole_numbers_lists_of_depths_and_defaults_are_read() {
        let text = "format = \"palpate-strokes/1\"\n[[stroke]]\npoints_mm = [[0, 1.5, 2], [3, 4, 5]]\n\
                    depth_mm = [4, 5.5]\n[[stroke]]\npoints_mm = []\ndepth_mm = 3\nwidth_mm = 1\ndirection = [0, 0, -1]\n";
        let strokes = parse(text).unwrap();
        assert_eq!(strokes[0].points_mm, [[0.0, 1.5, 2.0], [3.0, 4.0, 5.0]]);
        assert_eq!(strokes[0].depth_mm, Depth::Each(vec![4.0, 5.5]));
        assert_eq!((strokes[0].width_mm, strokes[0].direction), (0.0, None));
        assert_eq!(strokes[1].depth_mm, Depth::Same(3.0));
        assert_eq!(strokes[1].direction, Some([0.0, 0.0, -1.0]));
    }

    #[test]
    fn invalid_file_is_rejected_with_its_place_and_reason() {
        let stroke = "[[stroke]]\npoints_mm = [[0, 0, 0], [1, 0, 0]]\n";
        for (text, words) in [
            (String::new(), "no stroke"),
            (format!("{stroke}deph_mm = 3"), "deph_mm"),
            (stroke.to_owned(), "depth_mm"),
            (
                format!("{stroke}depth_mm = \"deep\""),
                "one depth per point",
            ),
            (
                "[[stroke]]\npoints_mm = [[0, 1]]\ndepth_mm = 1".to_owned(),
                "line 2",
            ),
            (
                format!("format = \"other/2\"\n{stroke}depth_mm = 3"),
                "other/2",
            ),
            ("stroke".to_owned(), "--help"),
        ] {
            let said = parse(&text).unwrap_err();
            assert!(
                said.contains(words) && said.contains("strokes.toml"),
                "{said}"
            );
        }
        let absent = read(Path::new("absent.toml")).unwrap_err().to_string();
        assert!(absent.contains("absent.toml"), "{absent}");
    }
}

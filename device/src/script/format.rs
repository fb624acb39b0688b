//! The file format of a script: millimetres and TOML in the file, metres and [`Script`] in memory.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::tool::ToolTable;
use super::{Ease, Hand, Script, Waypoint, bad_waypoint};
use crate::ScriptError;

/// The first line of every script.
const FORMAT: &str = "palpate-script/1";

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: String,
    #[serde(default)]
    repeat: bool,
    tool: ToolTable,
    #[serde(default)]
    hand: Hand,
    #[serde(default)]
    way: Vec<WaypointTable>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct WaypointTable {
    t_s: f64,
    at_mm: [f64; 3],
    #[serde(default)]
    button: bool,
    #[serde(default)]
    ease: Ease,
    #[serde(skip_serializing_if = "Option::is_none")]
    quat: Option<[f64; 4]>,
}

impl Script {
    /// Parses a script; the format is described at the head of [`script`](crate::script).
    pub fn from_toml(text: &str) -> Result<Self, ScriptError> {
        let file: File = toml::from_str(text).map_err(|e| explain(&e))?;
        if file.format != FORMAT {
            let found = file.format;
            let why = format_args!("format is \"{found}\", but this program reads \"{FORMAT}\"");
            return Err(ScriptError::new(why));
        }
        let mut waypoints = Vec::with_capacity(file.way.len());
        let mut orientation = UnitQuaternion::identity();
        for (i, way) in file.way.iter().enumerate() {
            if let Some(quat) = way.quat {
                let rule = "quat = [w, x, y, z] must have length 1 (within 1 %)";
                orientation = unit(quat).ok_or_else(|| bad_waypoint(i + 1, way.t_s, rule))?;
            }
            waypoints.push(Waypoint {
                t_s: way.t_s,
                position: Vector3::from(way.at_mm) / 1e3,
                orientation,
                button: way.button,
                ease: way.ease,
            });
        }
        Self::new(file.tool.tool(), file.hand, waypoints, file.repeat)
    }

    /// The script as a file; parsing it gives the same script to within a nanometre.
    pub fn to_toml(&self) -> String {
        let file = File {
            format: FORMAT.to_owned(),
            repeat: self.repeats(),
            tool: ToolTable::of(&self.tool(), to_mm),
            hand: self.hand(),
            way: self.waypoints().iter().map(way_table).collect(),
        };
        toml::to_string(&file).expect("a valid script has nothing that TOML can not say")
    }
}

fn way_table(way: &Waypoint) -> WaypointTable {
    let q = way.orientation.quaternion();
    WaypointTable {
        t_s: way.t_s,
        at_mm: way.position.map(to_mm).into(),
        button: way.button,
        ease: way.ease,
        quat: Some([q.w, q.i, q.j, q.k]),
    }
}

/// Millimetres, rounded to a picometre so that 0.0123 m is written 12.3 and not 12.299999999999999.
fn to_mm(m: f64) -> f64 {
    (m * 1e12).round() / 1e9
}

/// A length that is in metres here and in millimetres in the file.
pub(super) mod mm {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    #[allow(clippy::trivially_copy_pass_by_ref)]
    pub(in crate::script) fn serialize<S: Serializer>(m: &f64, to: S) -> Result<S::Ok, S::Error> {
        super::to_mm(*m).serialize(to)
    }

    pub(in crate::script) fn deserialize<'a, D: Deserializer<'a>>(
        from: D,
    ) -> Result<f64, D::Error> {
        f64::deserialize(from).map(|mm| mm / 1e3)
    }
}

fn unit([w, x, y, z]: [f64; 4]) -> Option<UnitQuaternion<f64>> {
    let q = Quaternion::new(w, x, y, z);
    let off = (q.norm() - 1.0).abs();
    if off <= 1e-12 {
        // Kept as in the file; normalising would change its last digit at every load.
        return Some(UnitQuaternion::new_unchecked(q));
    }
    (off <= 0.01).then(|| UnitQuaternion::from_quaternion(q))
}

/// The parser's message (it names line and column), and for an unknown key the nearest known one.
fn explain(error: &toml::de::Error) -> ScriptError {
    let text = error.to_string();
    let mut names = error.message().split('`').skip(1).step_by(2);
    let is_unknown = error.message().starts_with("unknown ");
    let nearest = names.next().filter(|_| is_unknown).and_then(|unknown| {
        names.max_by(|a, b| {
            strsim::jaro_winkler(unknown, a).total_cmp(&strsim::jaro_winkler(unknown, b))
        })
    });
    let hint = nearest.map(|n| format!("\ndid you mean `{n}`?"));
    ScriptError::new(format_args!(
        "the script is not understood: {}{}",
        text.trim_end(),
        hint.unwrap_or_default()
    ))
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use proptest::prelude::*;

    use super::super::{Ease, Hand, Script, Tool, ToolKind, Waypoint};

    /// The example at the head of the module, as the reader sees it.
    fn example() -> String {
        include_str!("mod.rs")
            .lines()
            .skip_while(|l| *l != "//! ```toml")
            .skip(1)
            .take_while(|l| *l != "//! ```")
            .map(|l| l.trim_start_matches("//!").trim_start())
            .collect::<Vec<_>>()
            .join("\n")
    }

    #[test]
    fn the_documented_example_parses() {
        let script = Script::from_toml(&example()).unwrap();
        assert_eq!(script.tool().kind, ToolKind::Probe);
        assert_eq!(
            script.hand(),
            Hand::default(),
            "the example shows the defaults"
        );
        assert_eq!(script.waypoints().len(), 2);
        assert_eq!(
            script.waypoints()[1].position,
            Vector3::new(0.0, 0.0, 0.045)
        );
        assert!(script.waypoints()[1].button && !script.waypoints()[0].button);
    }

    #[test]
    fn an_unknown_key_is_rejected_with_its_line_and_the_nearest_key() {
        let e = Script::from_toml(&example().replace("radius_mm", "radios_mm")).unwrap_err();
        let text = e.to_string();
        assert!(
            text.contains("radios_mm") && text.contains("line"),
            "{text}"
        );
        assert!(text.ends_with("did you mean `radius_mm`?"), "{text}");
        let e = Script::from_toml(&example().replace("\"probe\"", "\"prob\"")).unwrap_err();
        assert!(e.to_string().ends_with("did you mean `probe`?"), "{e}");
    }

    #[test]
    fn another_format_is_refused_by_name() {
        let e = Script::from_toml(&example().replace("script/1", "script/2")).unwrap_err();
        assert!(e.to_string().contains("\"palpate-script/2\""), "{e}");
    }

    #[test]
    fn broken_values_name_their_way_point() {
        for (from, to) in [
            ("t_s = 1.5", "t_s = -1.5"),
            ("t_s = 1.5", "t_s = nan"),
            ("[0.0, 0.0, 45.0]", "[0.0, inf, 45.0]"),
            ("quat = [1.0", "quat = [0.5"),
        ] {
            let text = example().replace(from, to);
            assert_ne!(text, example(), "the example holds {from}");
            let e = Script::from_toml(&text).unwrap_err();
            assert!(e.to_string().starts_with("way point 2"), "{e}");
        }
    }

    #[test]
    fn a_blade_has_a_default_length_and_a_probe_none() {
        let blade = Script::from_toml(&example().replace("\"probe\"", "\"blade\"")).unwrap();
        assert_eq!(blade.tool().length_m, 0.02);
        let e = Script::from_toml(&example().replace("# length_mm", "length_mm")).unwrap_err();
        assert!(e.to_string().contains("a probe has no length"), "{e}");
    }

    #[test]
    fn a_plate_needs_both_sides_and_a_needle_has_no_width() {
        let with = |kind: &str, sides: &str| {
            let text = example().replace("\"probe\"", kind);
            Script::from_toml(&text.replace("# width_mm = 10.0", sides))
        };
        let plate = with("\"plate\"", "width_mm = 10.0\nlength_mm = 30.0").unwrap();
        assert_eq!((plate.tool().length_m, plate.tool().width_m), (0.03, 0.01));
        for (kind, sides, key) in [
            ("\"plate\"", "width_mm = 10.0", "tool.length_mm"),
            ("\"forceps\"", "length_mm = 10.0", "tool.width_mm"),
            (
                "\"needle\"",
                "length_mm = 10.0\nwidth_mm = 1.0",
                "tool.width_mm",
            ),
            ("\"needle\"", "", "tool.length_mm"),
            ("\"probe\"", "width_mm = 1.0", "tool.width_mm"),
        ] {
            let e = with(kind, sides).unwrap_err();
            assert!(e.to_string().starts_with(key), "{kind}: {e}");
        }
    }

    proptest! {
        #[test]
        fn a_script_survives_a_write_and_read(
            steps in proptest::collection::vec(
                ((0.001f64..3.0, -0.5f64..0.5, -0.5f64..0.5), (any::<bool>(), any::<bool>(), -3.0f64..3.0)),
                1..20
            ),
            kind in 0..5,
            seed in 0u64..1 << 62,
        ) {
            let mut t_s = 0.0;
            let waypoints: Vec<_> = steps
                .iter()
                .map(|&((dt, x, y), (button, linear, turn))| {
                    t_s += dt;
                    Waypoint {
                        t_s,
                        position: Vector3::new(x, y, 0.1),
                        orientation: UnitQuaternion::new(Vector3::new(turn, 0.1, 0.0)),
                        button,
                        ease: if linear { Ease::Linear } else { Ease::MinimumJerk },
                    }
                })
                .collect();
            let (length_m, width_m) = (0.0123, 0.0125);
            let tool = match kind {
                0 => Tool::probe(0.0042),
                1 => Tool::blade(0.0005, length_m),
                2 => Tool { kind: ToolKind::Needle, ..Tool::blade(0.0005, length_m) },
                3 => Tool { kind: ToolKind::Plate, width_m, ..Tool::blade(0.002, length_m) },
                _ => Tool { kind: ToolKind::Forceps, width_m, ..Tool::blade(0.002, length_m) },
            };
            let hand = Hand { tremor_m: 0.000_3, seed, ..Hand::default() };
            let script = Script::new(tool, hand, waypoints, false).unwrap();
            let text = script.to_toml();
            let again = Script::from_toml(&text).unwrap();
            let sides = |t: Tool| [t.radius_m, t.length_m, t.width_m];
            prop_assert_eq!(again.tool().kind, tool.kind);
            for (a, b) in sides(again.tool()).into_iter().zip(sides(tool)) {
                prop_assert!((a - b).abs() < 1e-12);
            }
            prop_assert_eq!(again.hand().seed, seed);
            for (a, b) in script.waypoints().iter().zip(again.waypoints()) {
                prop_assert!((a.position - b.position).norm() < 1e-9);
                prop_assert!(a.orientation.angle_to(&b.orientation) < 1e-9);
                prop_assert_eq!((a.t_s, a.button, a.ease), (b.t_s, b.button, b.ease));
            }
            prop_assert_eq!(again.to_toml(), text, "the second writing changes nothing");
        }
    }
}

//! The `[report]` table of a scene: deviations from which a build warns.

use toml::de::DeTable;

use super::keys::Text;
use crate::InputError;

const KEYS: [&str; 6] = [
    "dice",
    "volume_percent",
    "distance_mm",
    "contact_mm2",
    "component_mm3",
    "self_intersections",
];

/// Deviations of a model from its input from which the build report warns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// Dice coefficient of a region below which it warns.
    pub dice: f64,
    /// Relative error of a region's volume in percent, above which it warns.
    pub volume_percent: f64,
    /// Distance in mm between the surfaces of a region in the model and in the input, in either direction, above
    /// which it warns; `None` for two spacings.
    pub distance_mm: Option<f64>,
    /// Contact area of two regions in mm² that was created or removed, above which it warns.
    pub contact_mm2: f64,
    /// Volume in mm³ from which it warns of a component that was lost or merged.
    pub component_mm3: f64,
    /// Number of pairs of triangles of a surface, or of two, that pass through each other, above which it warns.
    pub self_intersections: f64,
}

impl Default for Thresholds {
    fn default() -> Self {
        Self {
            dice: 0.9,
            volume_percent: 1.0,
            distance_mm: None,
            contact_mm2: 10.0,
            component_mm3: 1.0,
            self_intersections: 0.0,
        }
    }
}

impl Thresholds {
    /// Reads the table, if the scene has one.
    pub(super) fn read(text: &Text, root: &DeTable) -> Result<Self, InputError> {
        let mut this = Self::default();
        let Some(value) = root.get("report") else {
            return Ok(this);
        };
        let table = text.table("report", value, "a table that begins with [report]")?;
        text.refuse_unknown(table, &KEYS, "in [report]")?;
        let most = |key: &str| if key == "dice" { 1.0 } else { f64::INFINITY };
        let number = |key: &str| {
            let Some(value) = table.get(key) else {
                return Ok(None);
            };
            let number = text.number(key, value)?;
            if number.is_finite() && number >= 0.0 && number <= most(key) {
                return Ok(Some(number));
            }
            let bound = if key == "dice" { " to 1" } else { " or more" };
            let what = format!("{key} = {number} must be 0{bound}");
            Err(text.error(value.span().start, what))
        };
        this.dice = number("dice")?.unwrap_or(this.dice);
        this.volume_percent = number("volume_percent")?.unwrap_or(this.volume_percent);
        this.distance_mm = number("distance_mm")?;
        this.contact_mm2 = number("contact_mm2")?.unwrap_or(this.contact_mm2);
        this.component_mm3 = number("component_mm3")?.unwrap_or(this.component_mm3);
        this.self_intersections = number("self_intersections")?.unwrap_or(this.self_intersections);
        Ok(this)
    }

    /// The keys that differ from the default, with their values.
    pub(super) fn changed(&self) -> Vec<(&'static str, f64)> {
        let default = Self::default();
        let values = [
            (self.dice, default.dice),
            (self.volume_percent, default.volume_percent),
            (self.distance_mm.unwrap_or(-1.0), -1.0),
            (self.contact_mm2, default.contact_mm2),
            (self.component_mm3, default.component_mm3),
            (self.self_intersections, default.self_intersections),
        ];
        let pairs = KEYS.into_iter().zip(values);
        pairs
            .filter(|(_, (own, default))| own != default)
            .map(|(key, (own, _))| (key, own))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use crate::Scene;
    use std::path::Path;

    fn scene(report: &str) -> Result<Scene, crate::InputError> {
        let text = format!(
            "format = \"palpate-scene/1\"\nspacing_mm = 4.0\n[[region]]\nname = \"a\"\nsurface = \"a.stl\"\n\
             material = \"fat\"\n{report}"
        );
        Scene::parse(&text, Path::new("."))
    }

    #[test]
    fn thresholds_are_read_and_written_back() {
        let default = scene("").unwrap();
        assert_eq!(default.thresholds, super::Thresholds::default());
        assert!(!default.to_toml().contains("[report]"));
        let text = "[report]\ndice = 0.5\nvolume_percent = 3\ndistance_mm = 7.5\ncontact_mm2 = 0\ncomponent_mm3 = 30.0\n\
                    self_intersections = 2\n";
        let changed = scene(text).unwrap();
        let expected = super::Thresholds {
            dice: 0.5,
            volume_percent: 3.0,
            distance_mm: Some(7.5),
            contact_mm2: 0.0,
            component_mm3: 30.0,
            self_intersections: 2.0,
        };
        assert_eq!(changed.thresholds, expected);
        let again = Scene::parse(&changed.to_toml(), Path::new(".")).unwrap();
        assert_eq!(again.thresholds, expected);
    }

    #[test]
    fn invalid_thresholds_are_rejected_with_their_line() {
        for (table, named) in [
            (
                "[report]\ndice = 1.5\n",
                "line 8: dice = 1.5 must be 0 to 1",
            ),
            (
                "[report]\ncontact_mm2 = -1.0\n",
                "line 8: contact_mm2 = -1 must be 0 or more",
            ),
            (
                "[report]\nvolume = 1.0\n",
                "line 8: unknown key \"volume\" in [report]",
            ),
            (
                "[report]\ndistance_mm = \"far\"\n",
                "line 8: \"distance_mm\" must be a number",
            ),
        ] {
            let error = scene(table).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
    }
}

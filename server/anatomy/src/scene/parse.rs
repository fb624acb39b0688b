//! From TOML to a scene, with the line of every error.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use palpate_tissue::Material;
use palpate_tissue::material::{MaterialOverride, nearest_name};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::keys::Text;
use super::materials::{MATERIAL_KEYS, change, materials};
use super::{
    GRAVITY_MAX_M_S2, REGIONS_MAX, RegionSource, SCENE_BYTES_MAX, SCENE_FORMAT, Scene, SceneRegion,
    Thresholds,
};
use crate::InputError;
use crate::surface::Unit;

const SCENE_KEYS: [&str; 10] = [
    "format",
    "spacing_mm",
    "spacing_min_mm",
    "labels",
    "pinned",
    "fuse",
    "gravity_m_s2",
    "region",
    "report",
    "material",
];
const REGION_KEYS: [&str; 6] = ["name", "surface", "label", "labels", "material", "unit"];

impl Scene {
    /// Reads a scene file without its surfaces; [`super::SceneInput::load`] reads those.
    pub fn load(path: &Path) -> Result<Self, InputError> {
        let file = std::fs::File::open(path).map_err(InputError::io(path))?;
        let mut bytes = Vec::new();
        file.take(SCENE_BYTES_MAX + 1)
            .read_to_end(&mut bytes)
            .map_err(InputError::io(path))?;
        if bytes.len() as u64 > SCENE_BYTES_MAX {
            let bytes = std::fs::metadata(path).map_or(bytes.len() as u64, |m| m.len());
            let what = format_args!(
                "{bytes} bytes, a scene has at most {SCENE_BYTES_MAX}; is this a surface or a model? A \
                 scene is a TOML text that begins with format = \"{SCENE_FORMAT}\""
            );
            return Err(InputError::of(path, what));
        }
        let base = path.parent().unwrap_or(Path::new("")).to_owned();
        let file = path.display().to_string();
        let text = String::from_utf8(bytes).map_err(|e| {
            let valid = &e.as_bytes()[..e.utf8_error().valid_up_to()];
            let line = valid.split(|b| *b == b'\n').count();
            InputError::new(format_args!(
                "{file}, line {line}: this is not a text in UTF-8; a scene is a TOML text"
            ))
        })?;
        read(&Text { file, text: &text }, base)
    }

    /// Reads a scene from a text; surfaces are relative to `base`.
    pub fn parse(text: &str, base: &Path) -> Result<Self, InputError> {
        read(
            &Text {
                file: "scene".to_owned(),
                text,
            },
            base.to_owned(),
        )
    }
}

fn read(text: &Text, base: PathBuf) -> Result<Scene, InputError> {
    let document = DeTable::parse(text.text).map_err(|e| text.syntax(&e))?;
    let root = document.get_ref();
    refuse_other_formats(text, root)?;
    text.refuse_unknown(root, &SCENE_KEYS, "at the top of the scene")?;
    let materials = materials(text, root)?;
    let regions = regions(text, root, &materials)?;
    let (spacing_m, auto_spacing) = spacing(text, root)?;
    let pinned = pinned(text, root, &regions)?;
    Ok(Scene {
        spacing_m,
        auto_spacing,
        gravity_m_s2: gravity(text, root, !pinned.is_empty())?,
        pinned,
        thresholds: Thresholds::read(text, root)?,
        fuse: fuse(text, root, &regions)?,
        regions,
        materials,
        base,
    })
}

/// The format is checked first: a scene of another version may have unknown keys.
fn refuse_other_formats(text: &Text, root: &DeTable) -> Result<(), InputError> {
    let Some(format) = root.get("format") else {
        let what =
            format!("\"format\" is missing; a scene begins with format = \"{SCENE_FORMAT}\"");
        return Err(text.error(0, what));
    };
    let found = text.string("format", format)?;
    if found != SCENE_FORMAT {
        let what =
            format!("format \"{found}\" is not known; this version reads \"{SCENE_FORMAT}\"");
        return Err(text.error(format.span().start, what));
    }
    Ok(())
}

/// The spacing in m; or the least spacing, and that the builder determines it.
fn spacing(text: &Text, root: &DeTable) -> Result<(f64, bool), InputError> {
    let Some(value) = root.get("spacing_mm") else {
        let what = "\"spacing_mm\" is missing; add, say, spacing_mm = 4.0 or spacing_mm = \"auto\"";
        return Err(text.error(0, what));
    };
    let length = |key: &str, value: &Spanned<DeValue>| {
        let mm = text.number(key, value)?;
        if mm.is_finite() && mm > 0.0 {
            return Ok(mm * 1e-3);
        }
        let what = format!("{key} = {mm} must be a finite number above 0");
        Err(text.error(value.span().start, what))
    };
    let least = root.get("spacing_min_mm");
    if value.get_ref().as_str() == Some("auto") {
        let least = least.map(|v| length("spacing_min_mm", v)).transpose()?;
        return Ok((least.unwrap_or(0.0), true));
    }
    if let Some(least) = least {
        let what = "\"spacing_min_mm\" goes with spacing_mm = \"auto\"; leave one of them out";
        return Err(text.error(least.span().start, what));
    }
    Ok((length("spacing_mm", value)?, false))
}

fn regions(
    text: &Text,
    root: &DeTable,
    materials: &BTreeMap<String, MaterialOverride>,
) -> Result<Vec<SceneRegion>, InputError> {
    let labels = match root.get("labels") {
        Some(value) => Some(filled(text, "labels", value)?),
        None => None,
    };
    let wanted = "a list of tables that begin with [[region]]";
    let tables = match root.get("region") {
        Some(value) => text.array("region", value, wanted)?,
        None => &[],
    };
    if tables.is_empty() {
        return Err(text.error(
            0,
            "the scene has no region; add a [[region]] with name, surface (or label) and material",
        ));
    }
    if let Some(beyond) = tables.get(REGIONS_MAX) {
        let what = format!("{} regions, the limit is {REGIONS_MAX}", tables.len());
        return Err(text.error(beyond.span().start, what));
    }
    let mut regions: Vec<SceneRegion> = Vec::with_capacity(tables.len());
    for value in tables {
        let region = region(text, value, materials, labels.as_deref())?;
        if regions.iter().any(|r| r.name == region.name) {
            let what = format!("a second region is named \"{}\"; rename one", region.name);
            return Err(text.error(value.span().start, what));
        }
        regions.push(region);
    }
    Ok(regions)
}

fn region(
    text: &Text,
    value: &Spanned<DeValue>,
    materials: &BTreeMap<String, MaterialOverride>,
    labels: Option<&str>,
) -> Result<SceneRegion, InputError> {
    let table = text.table("region", value, "a table that begins with [[region]]")?;
    let known = [REGION_KEYS.as_slice(), &MATERIAL_KEYS].concat();
    text.refuse_unknown(table, &known, "in [[region]]")?;
    let needed = |key: &str| needed(text, value, table, key);
    let (material, at) = needed("material")?;
    let resolved = Material::resolve(&material, materials.get(&material)).map_err(|e| {
        // The scene's own materials are candidates for suggestions too.
        match nearest_name(&material, materials.keys().map(String::as_str)) {
            Some(own) if Material::built_in(&material).is_none() && own != material => text.error(
                at,
                format!("no material \"{material}\", did you mean \"{own}\" of this scene?"),
            ),
            _ => text.error(at, e.to_string()),
        }
    })?;
    let change = change(text, table)?;
    resolved
        .with(&change, "changed for this region")
        .map_err(|e| text.error(value.span().start, e.to_string()))?;
    Ok(SceneRegion {
        name: needed("name")?.0,
        source: source(text, value, table, labels)?,
        material,
        change,
    })
}

/// A required text, and its position.
fn needed(
    text: &Text,
    region: &Spanned<DeValue>,
    table: &DeTable,
    key: &str,
) -> Result<(String, usize), InputError> {
    let Some(value) = table.get(key) else {
        let what = format!("this [[region]] has no \"{key}\"; add {key} = \"...\"");
        return Err(text.error(region.span().start, what));
    };
    Ok((filled(text, key, value)?, value.span().start))
}

/// A text that is not empty.
fn filled(text: &Text, key: &str, value: &Spanned<DeValue>) -> Result<String, InputError> {
    let string = text.string(key, value)?;
    if string.is_empty() {
        return Err(text.error(value.span().start, format!("\"{key}\" is empty")));
    }
    Ok(string)
}

/// A region's shape: a surface, or labels of its own volume or of the scene's (`labels`).
fn source(
    text: &Text,
    region: &Spanned<DeValue>,
    table: &DeTable,
    labels: Option<&str>,
) -> Result<RegionSource, InputError> {
    let start = |key: &str| table.get_key_value(key).map(|(key, _)| key.span().start);
    let Some(label) = table.get("label") else {
        if let Some(at) = start("labels") {
            let what = "this [[region]] names a label volume and no label of it; add label = ...";
            return Err(text.error(at, what));
        }
        if table.get("surface").is_none() && labels.is_some() {
            let what = "this [[region]] has neither \"label\" nor \"surface\"; add label = ...";
            return Err(text.error(region.span().start, what));
        }
        return Ok(RegionSource::Surface {
            file: needed(text, region, table, "surface")?.0.into(),
            unit: unit(text, table)?,
        });
    };
    if let Some(at) = start("surface") {
        let what = "a [[region]] has a surface or a label, not both; remove one";
        return Err(text.error(at, what));
    }
    if let Some(at) = start("unit") {
        let what = "\"unit\" is for surfaces; a label volume has its unit in its header";
        return Err(text.error(at, what));
    }
    let file = match table.get("labels") {
        Some(value) => filled(text, "labels", value)?,
        None => labels.map(str::to_owned).ok_or_else(|| {
            let what = "no label volume is named; add labels = \"FILE.nii.gz\" to this [[region]] \
                        or at the top of the scene";
            text.error(label.span().start, what)
        })?,
    };
    Ok(RegionSource::Labels {
        file: file.into(),
        labels: label_numbers(text, label)?,
    })
}

fn label_numbers(text: &Text, value: &Spanned<DeValue>) -> Result<Vec<u16>, InputError> {
    let one = |value: &Spanned<DeValue>| {
        let number = text.number("label", value)?;
        if number >= 0.0 && number <= f64::from(u16::MAX) && number.trunc() == number {
            return Ok(number as u16);
        }
        let what = format!("label {number} is not a whole number from 0 to 65535");
        Err(text.error(value.span().start, what))
    };
    let DeValue::Array(list) = value.get_ref() else {
        return Ok(vec![one(value)?]);
    };
    if list.is_empty() {
        return Err(text.error(value.span().start, "\"label\" names no label"));
    }
    list.iter().map(one).collect()
}

fn unit(text: &Text, table: &DeTable) -> Result<Unit, InputError> {
    let Some(value) = table.get("unit") else {
        return Ok(Unit::default());
    };
    match text.string("unit", value)?.as_str() {
        "mm" => Ok(Unit::Millimetre),
        "m" => Ok(Unit::Metre),
        other => {
            let what = format!("unit \"{other}\" is not known; it is \"mm\" or \"m\"");
            Err(text.error(value.span().start, what))
        }
    }
}

/// Gravity in m/s²; a model under gravity needs a pinned region.
fn gravity(text: &Text, root: &DeTable, is_pinned: bool) -> Result<[f64; 3], InputError> {
    const KEY: &str = "gravity_m_s2";
    const WANTED: &str = "an acceleration such as [0.0, 0.0, -9.81]";
    let Some(value) = root.get(KEY) else {
        return Ok([0.0; 3]);
    };
    let refuse = |what: String| Err(text.error(value.span().start, what));
    let components = text.array(KEY, value, WANTED)?;
    let [x, y, z] = components else {
        let found = components.len();
        return refuse(format!("\"{KEY}\" must be {WANTED}, not a list of {found}"));
    };
    let gravity = [
        text.number(KEY, x)?,
        text.number(KEY, y)?,
        text.number(KEY, z)?,
    ];
    // Written so that a NaN fails.
    if !gravity.iter().all(|g| g.abs() < GRAVITY_MAX_M_S2) {
        return refuse(format!(
            "{KEY} = {gravity:?} must be below {GRAVITY_MAX_M_S2} m/s2 along each axis; the Earth's is 9.81"
        ));
    }
    if !is_pinned && gravity != [0.0; 3] {
        return refuse(format!(
            "{KEY} needs a pinned region that carries the weight; name a region in \"pinned\""
        ));
    }
    Ok(gravity)
}

fn pinned(text: &Text, root: &DeTable, regions: &[SceneRegion]) -> Result<Vec<String>, InputError> {
    let Some(value) = root.get("pinned") else {
        return Ok(Vec::new());
    };
    let mut pinned = Vec::new();
    for value in text.array("pinned", value, "a list of region names")? {
        let name = regions[named(text, "pinned", value, regions)?].name.clone();
        if !pinned.contains(&name) {
            pinned.push(name);
        }
    }
    Ok(pinned)
}

/// The pairs of regions to fuse.
fn fuse(
    text: &Text,
    root: &DeTable,
    regions: &[SceneRegion],
) -> Result<Vec<[usize; 2]>, InputError> {
    const WANTED: &str = "a list of pairs of region names such as [[\"femur\", \"tibia\"]]";
    let Some(value) = root.get("fuse") else {
        return Ok(Vec::new());
    };
    let mut pairs = Vec::new();
    for value in text.array("fuse", value, WANTED)? {
        let [a, b] = text.array("fuse", value, WANTED)? else {
            let what = format!("\"fuse\" must be {WANTED}");
            return Err(text.error(value.span().start, what));
        };
        let [a, b] = [
            named(text, "fuse", a, regions)?,
            named(text, "fuse", b, regions)?,
        ];
        pairs.push([a.min(b), a.max(b)]);
    }
    Ok(pairs)
}

/// The region that a value of `key` names.
fn named(
    text: &Text,
    key: &str,
    value: &Spanned<DeValue>,
    regions: &[SceneRegion],
) -> Result<usize, InputError> {
    let name = text.string(key, value)?;
    let names = || regions.iter().map(|r| r.name.as_str());
    names().position(|n| n == name).ok_or_else(|| {
        let hint = match nearest_name(&name, names()) {
            Some(n) => format!("did you mean \"{n}\"?"),
            None => format!("regions are {}", names().collect::<Vec<_>>().join(", ")),
        };
        let what = format!("{key} region \"{name}\" is not a region of this scene; {hint}");
        text.error(value.span().start, what)
    })
}

//! Materials of a scene: in `[material.NAME]`, and in a `[[region]]` for that region alone.

use std::collections::BTreeMap;

use palpate_tissue::material::MaterialOverride;
use palpate_tissue::{FibreAxis, Material};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::keys::Text;
use crate::InputError;

/// Keys that change a material, in `[material.NAME]` and in `[[region]]` alike.
pub(super) const MATERIAL_KEYS: [&str; 12] = [
    "young_kpa",
    "poisson",
    "stiffening",
    "fibre_ratio",
    "fibres",
    "compress_limit",
    "stretch_limit",
    "bottoms_out",
    "density_kg_m3",
    "friction_static",
    "friction_dynamic",
    "toughness_j_m2",
];

/// The `[material.NAME]` tables of a scene.
pub(super) fn materials(
    text: &Text,
    root: &DeTable,
) -> Result<BTreeMap<String, MaterialOverride>, InputError> {
    let Some(value) = root.get("material") else {
        return Ok(BTreeMap::new());
    };
    let tables = text.table("material", value, "tables that begin with [material.NAME]")?;
    let mut materials = BTreeMap::new();
    for (name, value) in tables {
        let place = format!("[material.{}]", name.get_ref());
        let table = text.table(
            name.get_ref(),
            value,
            &format!("a table that begins with {place}"),
        )?;
        text.refuse_unknown(table, &MATERIAL_KEYS, &format!("in {place}"))?;
        let change = change(text, table)?;
        // Checked also when no region uses it, because a number out of range is a mistake in any case.
        Material::resolve(name.get_ref(), Some(&change))
            .map_err(|e| text.error(name.span().start, e.to_string()))?;
        materials.insert(name.get_ref().to_string(), change);
    }
    Ok(materials)
}

/// The values of the [`MATERIAL_KEYS`] in a table; other keys are checked by the caller.
pub(super) fn change(text: &Text, table: &DeTable) -> Result<MaterialOverride, InputError> {
    let number = |key: &str| table.get(key).map(|v| text.number(key, v)).transpose();
    Ok(MaterialOverride {
        young_pa: number("young_kpa")?.map(|kpa| kpa * 1e3),
        poisson: number("poisson")?,
        stiffening: number("stiffening")?,
        fibre_ratio: number("fibre_ratio")?,
        fibre_axis: table.get("fibres").map(|v| fibres(text, v)).transpose()?,
        compress_limit: number("compress_limit")?,
        stretch_limit: number("stretch_limit")?,
        bottoms_out: table
            .get("bottoms_out")
            .map(|v| text.boolean("bottoms_out", v))
            .transpose()?,
        density_kg_m3: number("density_kg_m3")?,
        friction_static: number("friction_static")?,
        friction_dynamic: number("friction_dynamic")?,
        toughness_j_m2: number("toughness_j_m2")?,
    })
}

fn fibres(text: &Text, value: &Spanned<DeValue>) -> Result<FibreAxis, InputError> {
    const WANTED: &str = "\"long\" (the region's long axis) or a direction such as [0.0, 0.0, 1.0]";
    let refuse = |found: String| {
        let what = format!("\"fibres\" must be {WANTED}, not {found}");
        Err(text.error(value.span().start, what))
    };
    if let Some(word) = value.get_ref().as_str() {
        return match word {
            "long" => Ok(FibreAxis::Long),
            other => refuse(format!("\"{other}\"")),
        };
    }
    let components = text.array("fibres", value, WANTED)?;
    let [x, y, z] = components else {
        return refuse(format!("a list of {}", components.len()));
    };
    Ok(FibreAxis::Given([
        text.number("fibres", x)?,
        text.number("fibres", y)?,
        text.number("fibres", z)?,
    ]))
}

//! The built-in materials.

use super::Material;

/// Names of the built-in materials, in the order they are listed to a person.
pub const MATERIAL_NAMES: [&str; 11] = [
    "skin",
    "fat",
    "muscle",
    "bone",
    "fascia",
    "liver",
    "vessel",
    "cartilage",
    "foam",
    "rubber",
    "abs",
];

/// Young's modulus in kPa, density in kg/m³, static and dynamic friction, source.
type Entry = (f64, f64, f64, f64, &'static str);

/// A built-in material.
pub(super) fn built_in(name: &str) -> Option<Material> {
    let (young_kpa, density_kg_m3, friction_static, friction_dynamic, source) = entry(name)?;
    Some(Material {
        name: name.to_owned(),
        young_pa: young_kpa * 1e3,
        density_kg_m3,
        friction_static,
        friction_dynamic,
        source: source.to_owned(),
    })
}

/// Friction: dry skin 0.4-0.6 (Derler and Gerhardt 2012); wet inner tissue and solids are orders
/// of magnitude chosen by us, and each entry says so.
fn entry(name: &str) -> Option<Entry> {
    Some(match name {
        "skin" => (
            130.0,
            1090.0,
            0.5,
            0.4,
            "E: Diridollou et al. 2000 (suction on the forearm in vivo, 129 kPa); density: ICRU \
             Report 46, 1992; friction: Derler and Gerhardt 2012 (review, dry skin)",
        ),
        "fat" => (
            3.25,
            950.0,
            0.2,
            0.15,
            "E: Samani et al. 2007 (breast adipose tissue, 3.25 kPa); density: ICRU Report 46, \
             1992; friction: order of magnitude for wet tissue",
        ),
        "muscle" => (
            12.0,
            1050.0,
            0.2,
            0.15,
            "E: order of magnitude from Gennisson et al. 2010 (elastography of the relaxed \
             biceps, across the fibres); density: ICRU Report 46, 1992; friction: order of \
             magnitude for wet tissue",
        ),
        "bone" => (
            18.6e6,
            1920.0,
            0.3,
            0.25,
            "E: Rho, Ashman and Turner 1993 (cortical bone, microtensile, 18.6 GPa); density: \
             ICRU Report 46, 1992 (cortical); friction: order of magnitude for a wet solid",
        ),
        "fascia" => (
            1_000.0,
            1_100.0,
            0.2,
            0.15,
            "E: order of magnitude (MPa) from uniaxial tests of the human rectus sheath; density: \
             order of magnitude of dense connective tissue; friction: order of magnitude for wet \
             tissue",
        ),
        "liver" => (
            5.5,
            1060.0,
            0.15,
            0.1,
            "E: Roulot et al. 2008 (transient elastography of healthy people, 5.5 kPa); density: \
             ICRU Report 46, 1992; friction: order of magnitude for wet tissue",
        ),
        "vessel" => (
            500.0,
            1_100.0,
            0.15,
            0.1,
            "E: order of magnitude from Learoyd and Taylor 1966 (human arterial wall); density: \
             order of magnitude of connective tissue; friction: order of magnitude for wet tissue",
        ),
        "cartilage" => (
            600.0,
            1_100.0,
            0.05,
            0.03,
            "E: order of magnitude from Athanasiou et al. 1991 (aggregate modulus of the distal \
             femur); density: ICRU Report 46, 1992; friction: order of magnitude for wet \
             cartilage",
        ),
        "foam" => (
            50.0,
            40.0,
            0.6,
            0.5,
            "order of magnitude from Gibson and Ashby 1997 (flexible polyurethane foam); friction: \
             order of magnitude",
        ),
        "rubber" => (
            1_500.0,
            1_100.0,
            0.9,
            0.7,
            "order of magnitude from Ashby, Materials Selection in Mechanical Design (soft natural \
             rubber); friction: order of magnitude",
        ),
        "abs" => (
            2.2e6,
            1_050.0,
            0.35,
            0.3,
            "order of magnitude from Ashby, Materials Selection in Mechanical Design (ABS); \
             friction: order of magnitude",
        ),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_built_in_material_is_in_range_and_cites_a_source() {
        for name in MATERIAL_NAMES {
            let material = built_in(name).unwrap();
            assert_eq!(material.clone().checked(), Ok(material.clone()), "{name}");
            assert!(material.source.len() > 40, "{name}");
        }
    }
}

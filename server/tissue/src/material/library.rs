//! The built-in materials.
//!
//! Each entry quotes the literature for its Poisson's ratio. Soft tissue and rubber have [`NEARLY_INCOMPRESSIBLE`], below most
//! sources: a scene can raise it, at the cost of time. None stiffens and none has fibres: both depend on the site and the
//! application, so a scene sets them where needed.

use super::{Material, SOLID_J_M2};

/// Names of the built-in materials, in listing order.
pub const MATERIAL_NAMES: [&str; ENTRIES.len()] = {
    let mut names = [""; ENTRIES.len()];
    let mut i = 0;
    while i < names.len() {
        names[i] = ENTRIES[i].name;
        i += 1;
    }
    names
};

/// Values of a library entry; the others are those of [`Material::default`].
struct Entry {
    name: &'static str,
    young_kpa: f64,
    poisson: f64,
    density_kg_m3: f64,
    /// Static and dynamic.
    friction: [f64; 2],
    toughness_j_m2: f64,
    source: &'static str,
}

pub(super) fn built_in(name: &str) -> Option<Material> {
    let entry = ENTRIES.iter().find(|entry| entry.name == name)?;
    Some(Material {
        name: name.to_owned(),
        young_pa: entry.young_kpa * 1e3,
        poisson: entry.poisson,
        density_kg_m3: entry.density_kg_m3,
        friction_static: entry.friction[0],
        friction_dynamic: entry.friction[1],
        toughness_j_m2: entry.toughness_j_m2,
        source: entry.source.to_owned(),
        ..Material::default()
    })
}

/// Poisson's ratio of soft tissue and rubber. Sources give 0.45 to 0.5. Quick steps keep their time up to 0.47; at 0.49 forces
/// are 15 % off (DECISIONS.md). An indenter on a half-space is 6 % softer than at 0.5: its force follows
/// E/(1 - ν²). A thin layer between bone and tool is softer by more.
const NEARLY_INCOMPRESSIBLE: f64 = 0.45;

/// Friction: dry skin 0.4-0.6 (Derler and Gerhardt 2012). Values for wet inner tissue and solids are our own
/// orders of magnitude, and each entry marks them as such.
const WET: [f64; 2] = [0.2, 0.15];
/// Smooth serous surfaces of organs.
const SLIPPERY: [f64; 2] = [0.15, 0.1];

/// Toughness of soft organs, J/m²: pig liver under a blade 187 to 225, by needle 76 to 185 (review: Liu et al. 2022,
/// table 2).
const ORGAN_J_M2: f64 = 200.0;
/// Toughness of tissue with much collagen, J/m²: skin 1100 by needle, 1700 to 2800 by scissors; cartilage 140 to 1200
/// (Liu et al. 2022, table 2).
const COLLAGEN_J_M2: f64 = 1_100.0;

/// The entries, in listing order: connective tissue, organs of the trunk, technical materials.
const ENTRIES: [Entry; 20] = [
    Entry {
        name: "skin",
        young_kpa: 130.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1090.0,
        friction: [0.5, 0.4],
        toughness_j_m2: COLLAGEN_J_M2,
        source: "E: Diridollou et al. 2000 (suction on the forearm in vivo, 129 kPa); Poisson's \
                 ratio in the literature 0.48-0.5; density: ICRU Report 46, 1992; friction: Derler \
                 and Gerhardt 2012 (review, dry skin); toughness: pig skin by needle 1136 J/m² (Liu \
                 et al. 2022)",
    },
    Entry {
        name: "fat",
        young_kpa: 3.25,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 950.0,
        friction: WET,
        toughness_j_m2: 100.0,
        source: "E: Samani et al. 2007 (breast adipose tissue, 3.25 kPa); Poisson's ratio in the \
                 literature 0.49-0.5; density: ICRU Report 46, 1992; friction: order of magnitude \
                 for wet tissue; toughness: order of magnitude, below liver (tearing takes 4100 \
                 J/m², without a blade)",
    },
    Entry {
        name: "muscle",
        young_kpa: 12.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1050.0,
        friction: WET,
        toughness_j_m2: 550.0,
        source: "E: order of magnitude from Gennisson et al. 2010 (elastography of the relaxed \
                 biceps, across the fibres; several times that along them); Poisson's ratio in the \
                 literature 0.45-0.5; density: ICRU Report 46, 1992; friction: order of magnitude \
                 for wet tissue; toughness: lowest of pig muscle, 550 to 8000 J/m² (Liu et al. \
                 2022)",
    },
    Entry {
        name: "tendon",
        young_kpa: 1.2e6,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_120.0,
        friction: WET,
        toughness_j_m2: 2_000.0,
        source: "E: Maganaris and Paul 1999 (tibialis anterior in vivo, along the fibres, 1.2 GPa), \
                 taken for all directions; Poisson's ratio of the ground substance 0.4-0.5, order \
                 of magnitude; density: order of magnitude of dense connective tissue; friction: \
                 order of magnitude for wet tissue; toughness: order of magnitude",
    },
    Entry {
        name: "fascia",
        young_kpa: 1_000.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_100.0,
        friction: WET,
        toughness_j_m2: COLLAGEN_J_M2,
        source: "E: order of magnitude (MPa) from uniaxial tests of the human rectus sheath; \
                 Poisson's ratio 0.4-0.5, order of magnitude; density: order of magnitude of dense \
                 connective tissue; friction: order of magnitude for wet tissue; toughness: as \
                 skin, order of magnitude",
    },
    Entry {
        name: "bone",
        young_kpa: 18.6e6,
        poisson: 0.3,
        density_kg_m3: 1920.0,
        friction: [0.3, 0.25],
        toughness_j_m2: SOLID_J_M2,
        source: "E: Rho, Ashman and Turner 1993 (cortical bone, microtensile, 18.6 GPa); Poisson's \
                 ratio in the literature 0.3; density: ICRU Report 46, 1992 (cortical); friction: \
                 order of magnitude for a wet solid; toughness: order of magnitude",
    },
    Entry {
        name: "cancellous",
        young_kpa: 300e3,
        poisson: 0.3,
        density_kg_m3: 1_180.0,
        friction: [0.3, 0.25],
        toughness_j_m2: 1_000.0,
        source: "E: order of magnitude (tens of MPa to a GPa by site and density) of human \
                 trabecular bone; Poisson's ratio 0.3, order of magnitude; density: ICRU Report 46, \
                 1992 (spongiosa); friction: order of magnitude for a wet solid; toughness: order \
                 of magnitude",
    },
    Entry {
        name: "marrow",
        young_kpa: 2.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 980.0,
        friction: WET,
        toughness_j_m2: 50.0,
        source: "E: order of magnitude from Jansen et al. 2015 (intact porcine marrow, 0.25 to 25 \
                 kPa); Poisson's ratio 0.49, order of magnitude; density: ICRU Report 46, 1992 \
                 (yellow marrow); friction: order of magnitude for wet tissue; toughness: order of \
                 magnitude",
    },
    Entry {
        name: "cartilage",
        young_kpa: 600.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_100.0,
        friction: [0.05, 0.03],
        toughness_j_m2: 600.0,
        source: "E: order of magnitude from Athanasiou et al. 1991 (aggregate modulus of the distal \
                 femur); Poisson's ratio near 0.5 under a quick press, lower when it has drained, \
                 order of magnitude; density: ICRU Report 46, 1992; friction: order of magnitude \
                 for wet cartilage; toughness: 140 to 1200 J/m² (Liu et al. 2022)",
    },
    Entry {
        name: "vessel",
        young_kpa: 500.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_100.0,
        friction: SLIPPERY,
        toughness_j_m2: 290.0,
        source: "E: order of magnitude from Learoyd and Taylor 1966 (human arterial wall); \
                 Poisson's ratio 0.49, order of magnitude; density: order of magnitude of \
                 connective tissue; friction: order of magnitude for wet tissue; toughness: pig \
                 aorta under a blade, 290 J/m² (Liu et al. 2022)",
    },
    Entry {
        name: "liver",
        young_kpa: 5.5,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1060.0,
        friction: SLIPPERY,
        toughness_j_m2: ORGAN_J_M2,
        source: "E: Roulot et al. 2008 (transient elastography of healthy people, 5.5 kPa); \
                 Poisson's ratio 0.49, order of magnitude; density: ICRU Report 46, 1992; friction: \
                 order of magnitude for wet tissue; toughness: pig liver under a blade, 187 to 225 \
                 J/m² (Liu et al. 2022)",
    },
    Entry {
        name: "spleen",
        young_kpa: 15.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_060.0,
        friction: SLIPPERY,
        toughness_j_m2: ORGAN_J_M2,
        source: "E: order of magnitude (10-20 kPa) of elastography in healthy people; Poisson's \
                 ratio 0.49, order of magnitude; density: ICRU Report 46, 1992; friction: order of \
                 magnitude for wet tissue; toughness: as liver",
    },
    Entry {
        name: "kidney",
        young_kpa: 10.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_050.0,
        friction: SLIPPERY,
        toughness_j_m2: ORGAN_J_M2,
        source: "E: order of magnitude (5-20 kPa) of elastography in healthy people; Poisson's \
                 ratio 0.49, order of magnitude; density: ICRU Report 46, 1992; friction: order of \
                 magnitude for wet tissue; toughness: as liver",
    },
    Entry {
        name: "gallbladder",
        young_kpa: 10.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_030.0,
        friction: SLIPPERY,
        toughness_j_m2: ORGAN_J_M2,
        source: "everything an order of magnitude: a soft wall around a liquid, taken as one soft \
                 solid; Poisson's ratio 0.49; toughness as liver",
    },
    Entry {
        name: "lung",
        young_kpa: 2.0,
        poisson: 0.35,
        density_kg_m3: 260.0,
        friction: SLIPPERY,
        toughness_j_m2: ORGAN_J_M2,
        source: "E: order of magnitude (1-5 kPa) of lung parenchyma; Poisson's ratio 0.3-0.4, order \
                 of magnitude; density: ICRU Report 46, 1992 (inflated); friction: order of \
                 magnitude for wet tissue; toughness: as liver, order of magnitude",
    },
    Entry {
        name: "foam",
        young_kpa: 50.0,
        poisson: 0.3,
        density_kg_m3: 40.0,
        friction: [0.6, 0.5],
        toughness_j_m2: 100.0,
        source: "order of magnitude from Gibson and Ashby 1997 (flexible polyurethane foam); \
                 Poisson's ratio 0.3, order of magnitude; friction: order of magnitude; toughness: \
                 order of magnitude",
    },
    Entry {
        name: "rubber",
        young_kpa: 1_500.0,
        poisson: NEARLY_INCOMPRESSIBLE,
        density_kg_m3: 1_100.0,
        friction: [0.9, 0.7],
        toughness_j_m2: 1_000.0,
        source: "order of magnitude from Ashby, Materials Selection in Mechanical Design (soft \
                 natural rubber); Poisson's ratio 0.49-0.5; friction: order of magnitude; \
                 toughness: order of magnitude of rubber under a sharp blade",
    },
    Entry {
        name: "abs",
        young_kpa: 2.2e6,
        poisson: 0.38,
        density_kg_m3: 1_050.0,
        friction: [0.35, 0.3],
        toughness_j_m2: SOLID_J_M2,
        source: "order of magnitude from Ashby, Materials Selection in Mechanical Design (ABS); \
                 Poisson's ratio 0.35-0.4; friction: order of magnitude; toughness: order of \
                 magnitude",
    },
    Entry {
        name: "pla",
        young_kpa: 3.5e6,
        poisson: 0.36,
        density_kg_m3: 1_240.0,
        friction: [0.35, 0.3],
        toughness_j_m2: SOLID_J_M2,
        source: "order of magnitude from Ashby, Materials Selection in Mechanical Design \
                 (polylactide); Poisson's ratio 0.35-0.4; friction: order of magnitude; toughness: \
                 order of magnitude",
    },
    Entry {
        name: "polycarbonate",
        young_kpa: 2.3e6,
        poisson: 0.38,
        density_kg_m3: 1_200.0,
        friction: [0.35, 0.3],
        toughness_j_m2: SOLID_J_M2,
        source: "order of magnitude from Ashby, Materials Selection in Mechanical Design \
                 (polycarbonate); Poisson's ratio 0.37-0.4; friction: order of magnitude; \
                 toughness: order of magnitude",
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_materials_are_in_range_and_cite_a_source() {
        for Entry { name, .. } in ENTRIES {
            let material = built_in(name).unwrap();
            assert_eq!(material.clone().checked(), Ok(material.clone()), "{name}");
            assert!(material.source.len() > 40, "{name}");
            assert!(material.source.contains("Poisson"), "{name}");
            assert!(material.source.contains("toughness"), "{name}");
        }
    }
}

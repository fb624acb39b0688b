//! Scenes: accepted and rejected texts, with line and text of each error.

#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::path::Path;

use palpate_anatomy::sample::Sample;
use palpate_anatomy::scene::REGIONS_MAX;
use palpate_anatomy::{InputError, RegionSource, Scene, SceneInput, Unit};
use palpate_tissue::material::{MATERIAL_NAMES, MaterialOverride};
use palpate_tissue::{FibreAxis, Material};
use proptest::prelude::*;

const THIGH: &str = r#"format = "palpate-scene/1"
spacing_mm = 4.0
pinned = ["femur"]

[[region]]
name = "subcutaneous"
surface = "thigh_skin.stl"
material = "fat"

[[region]]
name = "muscle"
surface = "sub/thigh_muscle.stl"
material = "muscle"

[[region]]
name = "femur"
surface = "thigh_femur.stl"
material = "bone"
unit = "m"

[material.fat]
young_kpa = 10.0
density_kg_m3 = 950.0
friction_static = 0.4
friction_dynamic = 0.3
"#;

fn parse(text: &str) -> Result<Scene, InputError> {
    Scene::parse(text, Path::new("base"))
}

#[test]
fn parsed_scene_matches_its_text() {
    let scene = parse(THIGH).unwrap();
    assert!((scene.spacing_m - 4e-3).abs() < 1e-15);
    assert_eq!(scene.pinned, ["femur"]);
    let names: Vec<&str> = scene.regions.iter().map(|r| r.name.as_str()).collect();
    assert_eq!(names, ["subcutaneous", "muscle", "femur"], "in scene order");
    assert_eq!(scene.source_path(1), Path::new("base/sub/thigh_muscle.stl"));
    let unit_of = |r: usize| match scene.regions[r].source {
        RegionSource::Surface { unit, .. } => Some(unit),
        RegionSource::Labels { .. } => None,
    };
    assert_eq!(
        (unit_of(0), unit_of(2)),
        (Some(Unit::Millimetre), Some(Unit::Metre))
    );
    let regions = scene.model_regions().unwrap();
    assert_eq!(
        regions.iter().map(|r| r.pinned).collect::<Vec<_>>(),
        [false, false, true]
    );
    let fat = &regions[0].material;
    assert_eq!((fat.young_pa, fat.density_kg_m3), (10_000.0, 950.0));
    assert_eq!((fat.friction_static, fat.friction_dynamic), (0.4, 0.3));
    assert_eq!(
        Some(&regions[1].material),
        Material::built_in("muscle").as_ref()
    );
}

#[test]
fn scene_text_round_trip() {
    let scene = parse(THIGH).unwrap();
    let text = scene.to_toml();
    let again = parse(&text).unwrap();
    assert_eq!(again.to_toml(), text);
    assert_eq!(again.regions, scene.regions);
    assert_eq!(
        again.model_regions().unwrap(),
        scene.model_regions().unwrap()
    );
    for sample in Sample::ALL {
        let scene = sample.generate().scene;
        assert_eq!(
            Scene::parse(&scene.to_toml(), Path::new(""))
                .unwrap()
                .regions,
            scene.regions
        );
    }
}

/// Text to replace in [`THIGH`], its replacement, and words of the expected message.
const MISTAKES: [(&str, &str, &[&str]); 39] = [
    (
        "young_kpa = 10.0",
        "poisson = 0.5",
        &["line 21", "poisson = 0.5", "between 0.25 and 0.49"],
    ),
    (
        "young_kpa = 10.0",
        "poison = 0.3",
        &["line 22", "did you mean \"poisson\""],
    ),
    (
        "young_kpa = 10.0",
        "fibres = \"short\"",
        &["line 22", "\"long\"", "\"short\""],
    ),
    (
        "young_kpa = 10.0",
        "bottoms_out = 1",
        &["line 22", "\"bottoms_out\"", "true or false"],
    ),
    (
        "young_kpa = 10.0",
        "fibres = [1.0, 2.0]",
        &["line 22", "direction", "a list of 2"],
    ),
    (
        "young_kpa = 10.0",
        "fibres = [0, 0, 0.0]",
        &["line 21", "not all zero"],
    ),
    (
        "unit = \"m\"",
        "stretch_limit = 0.5",
        &["line 15", "\"bone\"", "stretch_limit = 0.5"],
    ),
    (
        "unit = \"m\"",
        "stifening = 0.5",
        &["line 19", "did you mean \"stiffening\""],
    ),
    (
        "spacing_mm",
        "spacing",
        &["line 2", "\"spacing\"", "\"spacing_mm\""],
    ),
    (
        "pinned =",
        "pined =",
        &["line 3", "did you mean \"pinned\""],
    ),
    (
        "surface = \"thigh_skin",
        "surfaces = \"thigh_skin",
        &["line 7", "did you mean \"surface\""],
    ),
    (
        "friction_dynamic",
        "friction_dynamics",
        &["line 25", "[material.fat]", "\"friction_dynamic\""],
    ),
    (
        "unit = \"m\"",
        "colour = \"m\"",
        &[
            "line 19",
            "known are name, surface, label, labels, material, unit",
        ],
    ),
    (
        "material = \"muscle\"",
        "material = \"musle\"",
        &["line 13", "\"muscle\"", "cartilage, vessel"],
    ),
    (
        "material = \"bone\"",
        "material = \"xyzzyx\"",
        &["line 18", "[material.xyzzyx]"],
    ),
    (
        "[\"femur\"]",
        "[\"fermur\"]",
        &["line 3", "did you mean \"femur\""],
    ),
    (
        "[\"femur\"]",
        "[\"hip\"]",
        &["line 3", "regions are subcutaneous, muscle, femur"],
    ),
    (
        "[\"femur\"]",
        "\"femur\"",
        &["line 3", "a list of region names, not string"],
    ),
    (
        "pinned = [\"femur\"]",
        "fuse = [[\"femur\", \"musle\"]]",
        &["line 3", "fuse region \"musle\"", "did you mean \"muscle\""],
    ),
    (
        "pinned = [\"femur\"]",
        "fuse = [[\"femur\", \"hip\"]]",
        &["line 3", "regions are subcutaneous, muscle, femur"],
    ),
    (
        "pinned = [\"femur\"]",
        "fuse = [\"femur\", \"muscle\"]",
        &["line 3", "pairs of region names", "not string"],
    ),
    (
        "pinned = [\"femur\"]",
        "fuse = [[\"femur\"]]",
        &["line 3", "\"fuse\" must be a list of pairs"],
    ),
    (
        "pinned = [\"femur\"]",
        "fuse = [[\"femur\", 2]]",
        &["line 3", "not integer"],
    ),
    (
        "name = \"muscle\"",
        "name = \"femur\"",
        &["second region is named \"femur\""],
    ),
    ("4.0", "0", &["line 2", "above 0"]),
    ("4.0", "-1.5", &["line 2", "above 0"]),
    ("4.0", "nan", &["line 2", "above 0"]),
    ("4.0", "inf", &["line 2", "above 0"]),
    ("4.0", "\"4\"", &["line 2", "a number, not string"]),
    ("spacing_mm = 4.0\n", "", &["\"spacing_mm\" is missing"]),
    (
        "spacing_mm = 4.0",
        "spacing_mm = 4.0\nspacing_min_mm = 2.0",
        &["line 3", "goes with spacing_mm = \"auto\""],
    ),
    (
        "spacing_mm = 4.0",
        "spacing_mm = \"auto\"\nspacing_min_mm = -2.0",
        &["line 3", "spacing_min_mm = -2", "above 0"],
    ),
    (
        "palpate-scene/1",
        "palpate-scene/2",
        &["line 1", "this version reads \"palpate-scene/1\""],
    ),
    (
        "format = \"palpate-scene/1\"",
        "",
        &["\"format\" is missing"],
    ),
    ("name = \"femur\"\n", "", &["line 15", "no \"name\""]),
    (
        "unit = \"m\"",
        "unit = \"inch\"",
        &["line 19", "\"mm\" or \"m\""],
    ),
    (
        "young_kpa = 10.0",
        "young_kpa = -1",
        &["line 21", "young_kpa = -1", "between"],
    ),
    (
        "friction_static = 0.4",
        "friction_static = 0.2",
        &["friction_dynamic = 0.3", "friction_static = 0.2"],
    ),
    (
        "[material.fat]",
        "[material.gel",
        &["line 21", "not valid TOML"],
    ),
];

#[test]
fn fused_pairs_name_regions_in_any_order() {
    assert_eq!(parse(THIGH).unwrap().fuse, [[0_usize; 2]; 0]);
    let line = "fuse = [[\"femur\", \"muscle\"], [\"muscle\", \"muscle\"]]\npinned =";
    let scene = parse(&THIGH.replacen("pinned =", line, 1)).unwrap();
    assert_eq!(scene.fuse, [[1, 2], [1, 1]]);
    assert_eq!(parse(&scene.to_toml()).unwrap().fuse, scene.fuse);
}

#[test]
fn errors_name_line_and_remedy() {
    for (from, to, words) in MISTAKES {
        let text = THIGH.replacen(from, to, 1);
        assert_ne!(text, THIGH, "{from}");
        let message = parse(&text).unwrap_err().to_string();
        for word in words {
            assert!(
                message.contains(word),
                "{from} -> {to}: {message} (no {word})"
            );
        }
    }
    let message = parse("format = \"palpate-scene/1\"\nspacing_mm = 4\n")
        .unwrap_err()
        .to_string();
    assert!(message.contains("no region"), "{message}");
}

#[test]
fn gravity_is_validated_and_needs_a_pinned_region() {
    assert_eq!(parse(THIGH).unwrap().gravity_m_s2, [0.0; 3]);
    let with = |value: &str| {
        let line = format!("gravity_m_s2 = {value}\npinned =");
        parse(&THIGH.replacen("pinned =", &line, 1))
    };
    let scene = with("[0, -9.81, 0.5]").unwrap();
    assert_eq!(scene.gravity_m_s2, [0.0, -9.81, 0.5]);
    assert_eq!(
        parse(&scene.to_toml()).unwrap().gravity_m_s2,
        scene.gravity_m_s2
    );
    for (value, words) in [
        ("9.81", ["[0.0, 0.0, -9.81]", "gravity_m_s2"]),
        ("[0, 9.81]", ["a list of 2", "[0.0, 0.0, -9.81]"]),
        ("[0, 0, \"down\"]", ["a number", "gravity_m_s2"]),
        ("[0, 0, -9810]", ["below 100 m/s2", "9.81"]),
        ("[0, 0, nan]", ["below 100 m/s2", "NaN"]),
    ] {
        let message = with(value).unwrap_err().to_string();
        let known = words.iter().all(|w| message.contains(w));
        assert!(known && message.contains("line"), "{value}: {message}");
    }
    let loose = with("[0, 0, -9.81]").unwrap().to_toml();
    let loose = loose.replace("pinned = [\"femur\"]\n", "");
    let message = parse(&loose).unwrap_err().to_string();
    assert!(message.contains("name a region in \"pinned\""), "{message}");
}

#[test]
fn names_with_quotes_and_line_breaks_survive_writing() {
    let mut scene = parse(THIGH).unwrap();
    scene.regions[1].name = "a \"b\" \\ [c]\n\u{1} d".to_owned();
    assert_eq!(parse(&scene.to_toml()).unwrap().regions, scene.regions);
}

#[test]
fn new_material_must_be_complete_and_known_one_may_change_in_part() {
    let gel = THIGH.replace("\"muscle\"\n\n", "\"gel\"\n\n") + "[material.gel]\nyoung_kpa = 3\n";
    let message = parse(&gel).unwrap_err().to_string();
    assert!(
        message.contains("density_kg_m3") && message.contains("gel"),
        "{message}"
    );
    let scene = parse(&(gel + "density_kg_m3 = 1000\n")).unwrap();
    let material = scene.material(1).unwrap();
    assert_eq!(
        (material.young_pa, material.density_kg_m3),
        (3_000.0, 1_000.0)
    );
    let slip = scene
        .to_toml()
        .replace("material = \"gel\"", "material = \"gell\"");
    let message = parse(&slip).unwrap_err().to_string();
    assert!(
        message.contains("did you mean \"gel\" of this scene"),
        "{message}"
    );
    let softer = MaterialOverride {
        young_pa: Some(1e3),
        ..MaterialOverride::default()
    };
    let skin = Material::resolve("skin", Some(&softer)).unwrap();
    assert_eq!(
        skin.density_kg_m3,
        Material::built_in("skin").unwrap().density_kg_m3
    );
    assert!(skin.source.starts_with("changed by the scene"));
}

#[test]
fn region_override_affects_that_region_only() {
    let text = THIGH
        .replace(
            "unit = \"m\"",
            "young_kpa = 20\nfibres = [0, 3, 4]\nfibre_ratio = 2",
        )
        .replace("material = \"bone\"", "material = \"fat\"")
        .replace(
            "young_kpa = 10.0",
            "young_kpa = 10.0\nstiffening = 7\nbottoms_out = false",
        );
    let scene = parse(&text).unwrap();
    let [first, last] = [0, 2].map(|r| scene.material(r).unwrap());
    assert_eq!((first.young_pa, last.young_pa), (10e3, 20e3));
    assert_eq!((first.stiffening, last.stiffening), (7.0, 7.0));
    assert!(!first.bottoms_out && !last.bottoms_out);
    assert!(Material::default().bottoms_out);
    assert_eq!((first.fibre_ratio, last.fibre_ratio), (1.0, 2.0));
    assert_eq!(last.fibre_axis, FibreAxis::Given([0.0, 3.0, 4.0]));
    assert!(
        last.source
            .starts_with("changed for this region: changed by")
    );
    let again = parse(&scene.to_toml()).unwrap();
    assert_eq!(
        (&again.regions, &again.materials),
        (&scene.regions, &scene.materials)
    );
}

#[test]
fn listed_materials_exist() {
    for name in MATERIAL_NAMES {
        let material = Material::built_in(name).unwrap();
        assert_eq!(material.name, name);
        assert!(material.friction_dynamic <= material.friction_static);
    }
    assert!(Material::built_in("unobtainium").is_none());
}

#[test]
fn too_many_regions_are_rejected() {
    let mut text = "format = \"palpate-scene/1\"\nspacing_mm = 4\n".to_owned();
    for i in 0..=REGIONS_MAX {
        writeln!(
            text,
            "[[region]]\nname = \"r{i}\"\nsurface = \"r.stl\"\nmaterial = \"fat\""
        )
        .unwrap();
    }
    let message = parse(&text).unwrap_err().to_string();
    let words = format!("{} regions, the limit is {REGIONS_MAX}", REGIONS_MAX + 1);
    assert!(message.contains(&words), "{message}");
}

#[test]
fn invalid_scene_files_are_rejected_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let missing = Scene::load(&dir.path().join("gone.toml"))
        .unwrap_err()
        .to_string();
    assert!(missing.contains("gone.toml"), "{missing}");
    let path = dir.path().join("model.toml");
    std::fs::write(&path, [0xff, 0xfe, 0x00]).unwrap();
    assert!(
        Scene::load(&path)
            .unwrap_err()
            .to_string()
            .contains("not a text")
    );
    std::fs::write(&path, vec![b' '; 2 << 20]).unwrap();
    assert!(
        Scene::load(&path)
            .unwrap_err()
            .to_string()
            .contains("2097152 bytes")
    );
}

#[test]
fn surface_error_names_region_and_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = Sample::Handle.generate().write(dir.path(), false).unwrap();
    let core = dir.path().join("handle_core.stl");
    std::fs::remove_file(&core).unwrap();
    let message = SceneInput::load(&path).unwrap_err().to_string();
    assert!(
        message.contains("region \"core\"") && message.contains("handle_core.stl"),
        "{message}"
    );
    let (_, mut open) = Sample::Handle.generate().surfaces.remove(1);
    open.triangles.pop();
    open.write_stl(&core).unwrap();
    let message = SceneInput::load(&path).unwrap_err().to_string();
    for words in ["region \"core\"", "handle_core.stl", "3 boundary edges"] {
        assert!(message.contains(words), "{message}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(128) })]

    /// A damaged scene is read or rejected, without a panic.
    #[test]
    fn damaged_scene_never_panics(at in 0..THIGH.len(), length in 0_usize..20, with in "[\\PC\n\"\\[\\]=.]{0,8}") {
        let end = (at + length).min(THIGH.len());
        let text = format!("{}{with}{}", &THIGH[..at], &THIGH[end..]);
        if let Ok(scene) = parse(&text) {
            scene.model_regions().unwrap();
            parse(&scene.to_toml()).unwrap();
        }
    }
}

#[test]
fn automatic_spacing_survives_writing() {
    for least in ["", "spacing_min_mm = 2.5\n"] {
        let text = format!(
            "format = \"palpate-scene/1\"\nspacing_mm = \"auto\"\n{least}{}",
            region("a")
        );
        let scene = parse(&text).unwrap();
        assert!(scene.auto_spacing);
        assert_eq!(parse(&scene.to_toml()).unwrap(), scene);
    }
}

fn region(name: &str) -> String {
    format!("[[region]]\nname = \"{name}\"\nsurface = \"{name}.stl\"\nmaterial = \"fat\"\n")
}

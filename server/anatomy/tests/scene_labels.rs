//! Scenes whose regions come from label volumes, all or some: reading, errors, building.

#![allow(clippy::unwrap_used)]

mod label_files;

use std::fmt::Write as _;
use std::path::Path;

use label_files::{Folder, Nifti};
use palpate_anatomy::{BuildReport, LayerReport, RegionSource, Scene, SceneInput, Surface, build};
use palpate_tissue::{Topology, Vec3};

const THIGH: &str = r#"format = "palpate-scene/1"
spacing_mm = 4.0
labels = "thigh.nii.gz"

[[region]]
name = "subcutaneous"
label = 1
material = "fat"

[[region]]
name = "muscle"
label = [2, 5]
material = "muscle"

[[region]]
name = "femur"
surface = "femur.stl"
material = "bone"

[[region]]
name = "tumour"
labels = "tumour.nrrd"
label = 0
material = "liver"
"#;

#[test]
fn region_source_is_a_surface_or_labels_of_own_or_scene_volume() {
    let scene = Scene::parse(THIGH, Path::new("base")).unwrap();
    let labels = |r: usize| match &scene.regions[r].source {
        RegionSource::Labels { labels, .. } => labels.clone(),
        RegionSource::Surface { .. } => Vec::new(),
    };
    assert_eq!((labels(0), labels(1)), (vec![1], vec![2, 5]));
    assert_eq!((labels(2), labels(3)), (vec![], vec![0]));
    assert_eq!(scene.source_path(1), Path::new("base/thigh.nii.gz"));
    assert_eq!(scene.source_path(2), Path::new("base/femur.stl"));
    assert_eq!(scene.source_path(3), Path::new("base/tumour.nrrd"));
    let again = Scene::parse(&scene.to_toml(), Path::new("base")).unwrap();
    assert_eq!(again.regions, scene.regions);
}

#[test]
fn label_errors_name_the_line() {
    let mistakes: [(&str, &str, &[&str]); 9] = [
        (
            "label = 1\n",
            "",
            &["line 5", "neither \"label\" nor \"surface\""],
        ),
        (
            "label = 1\n",
            "label = 1\nsurface = \"a.stl\"\n",
            &["line 8", "not both"],
        ),
        (
            "label = 1\n",
            "label = 1\nunit = \"m\"\n",
            &["line 8", "header"],
        ),
        ("label = 1\n", "label = -1\n", &["line 7", "0 to 65535"]),
        ("label = 1\n", "label = 1.5\n", &["line 7", "0 to 65535"]),
        ("label = 1\n", "label = []\n", &["line 7", "names no label"]),
        ("label = 1\n", "label = \"one\"\n", &["line 7", "a number"]),
        ("label = 0\n", "", &["line 22", "no label of it"]),
        (
            "labels = \"thigh.nii.gz\"\n",
            "",
            &["line 6", "no label volume is named"],
        ),
    ];
    for (from, to, words) in mistakes {
        let text = THIGH.replacen(from, to, 1);
        let message = Scene::parse(&text, Path::new("")).unwrap_err().to_string();
        for word in words {
            assert!(
                message.contains(word),
                "{from} -> {to}: {message} (no {word})"
            );
        }
    }
}

/// A miniature thigh: 1 around 2 around 3, flat at the image border.
fn drum() -> Vec<u8> {
    image(|[x, y, _]| {
        let r = (x - 19.5).hypot(y - 19.5);
        [6.0, 13.0, 18.0].iter().filter(|limit| r < **limit).count() as u8
    })
}

/// A leaning column of 2 in a skin of 1 that is one voxel thick within each slice.
fn leaning() -> Vec<u8> {
    let inside = |x: f64, y: f64, z: f64| {
        let (x, y) = (x - 19.5 - 0.37 * (z - 11.5), y - 19.5 - 0.21 * (z - 11.5));
        x.hypot(y) < 13.0
    };
    image(|[x, y, z]| {
        let beside = [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)];
        let skin = beside.iter().any(|(u, v)| !inside(x + u, y + v, z));
        u8::from(inside(x, y, z)) * (2 - u8::from(skin))
    })
}

/// Two balls of 2 in a block of 1, joined by an oblique rod that is two voxels thick.
fn dumb_bell() -> Vec<u8> {
    let ends = [Vec3::new(10.0, 9.0, 7.0), Vec3::new(29.0, 28.0, 17.0)];
    let way = (ends[1] - ends[0]).normalize();
    image(|at| {
        let p = Vec3::from(at);
        let in_ball = ends.iter().any(|e| (p - e).norm() < 5.0);
        let from = p - ends[0];
        let along = from.dot(&way);
        let in_rod = along > 0.0 && along < 30.0 && (from - way * along).norm() < 1.0;
        let in_block = (2.0..38.0).contains(&at[0]) && (2.0..38.0).contains(&at[1]);
        u8::from(in_block) + u8::from(in_ball || in_rod && along < (ends[1] - ends[0]).norm())
    })
}

/// An image of 2 mm voxels.
fn image(label: impl Fn([f64; 3]) -> u8) -> Vec<u8> {
    let (nx, ny, nz) = (40_usize, 40_usize, 24_usize);
    let mut file = Nifti::bytes();
    file.dims(&[3, nx as i16, ny as i16, nz as i16, 1, 1, 1, 1]);
    for (r, origin) in [-39.0, -39.0, 100.0].into_iter().enumerate() {
        for c in 0..3 {
            file.float(280 + 16 * r + 4 * c, if r == c { 2.0 } else { 0.0 });
        }
        file.float(292 + 16 * r, origin).float(80 + 4 * r, 2.0);
    }
    file.data = (0..nx * ny * nz)
        .map(|n| label([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64)))
        .collect();
    file.file()
}

fn drum_scene(regions: &[(&str, &str)]) -> String {
    let mut text =
        "format = \"palpate-scene/1\"\nspacing_mm = 4.0\nlabels = \"drum.nii\"\n".to_owned();
    for (name, source) in regions {
        writeln!(
            text,
            "[[region]]\nname = \"{name}\"\n{source}\nmaterial = \"fat\""
        )
        .unwrap();
    }
    text
}

fn built(folder: &Folder, text: &str) -> (SceneInput, BuildReport) {
    let input = SceneInput::load(&folder.write("scene.toml", text.as_bytes())).unwrap();
    let (model, report) = build(&input, &mut |_, _| {}).unwrap();
    let topology = Topology::new(model.into());
    assert!(topology.boundary().is_closed());
    assert!(report.outer_surface.closed && report.outer_surface.components == 1);
    (input, report)
}

#[test]
fn labelled_scene_keeps_voxel_volumes() {
    let folder = Folder::new();
    folder.write("drum.nii", &drum());
    // For any order of the regions: every voxel belongs to the region of its label.
    for order in [
        ["label = 1", "label = 2", "label = 3"],
        ["label = 3", "label = 1", "label = 2"],
    ] {
        let names = ["a", "b", "c"];
        let regions: Vec<(&str, &str)> = names.into_iter().zip(order).collect();
        let (input, report) = built(&folder, &drum_scene(&regions));
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        for (region, voxels) in report.regions.iter().zip(&input.voxels_m3) {
            let voxels = voxels.unwrap() * 1e9;
            assert!((region.input_volume_mm3 / voxels - 1.0).abs() < 1e-9);
            let part = region.volume_mm3 / voxels;
            assert!((part - 1.0).abs() < 0.01, "{}: {part}", region.name);
        }
    }
}

#[test]
fn one_voxel_skin_is_one_piece_and_separates_its_sides() {
    let folder = Folder::new();
    folder.write("drum.nii", &leaning());
    for spacing in ["2.0", "3.0", "3.5"] {
        let text = drum_scene(&[("skin", "label = 1"), ("fat", "label = 2")]);
        let (_, report) = built(&folder, &text.replace("4.0", spacing));
        assert_volumes(&report, 0);
        let [skin, fat] = [0, 1].map(|r| report.regions[r].components);
        assert_eq!((skin, fat), (1, 1), "at {spacing}");
        let layers = |inside: &str, outside: Option<&str>| {
            let own = |l: &&LayerReport| l.inside == inside && l.outside.as_deref() == outside;
            report.layers.iter().find(own).map_or(0, |l| l.components)
        };
        assert_eq!(layers("fat", Some("skin")), 1, "at {spacing}");
        // Fat reaches the surface only at the two ends of the image.
        assert_eq!(layers("fat", None), 2, "at {spacing}");
    }
}

#[test]
fn connected_part_stays_connected_below_cell_size() {
    let folder = Folder::new();
    folder.write("drum.nii", &dumb_bell());
    for spacing in ["3.0", "4.0", "5.0", "6.0"] {
        let text = drum_scene(&[("block", "label = 1"), ("bell", "label = 2")]);
        let (_, report) = built(&folder, &text.replace("4.0", spacing));
        assert_volumes(&report, 0);
        assert_eq!(report.regions[1].components, 1, "at {spacing}");
    }
}

#[test]
fn known_triangle_sides_agree_with_probing() {
    let folder = Folder::new();
    folder.write("drum.nii", &drum());
    let text = drum_scene(&[("a", "label = 2"), ("b", "label = 1"), ("c", "label = 3")]);
    let (mut input, told) = built(&folder, &text);
    assert!(input.sides.iter().all(|a| !a.is_empty()));
    input.sides = vec![Vec::new(); 3];
    let (_, looked) = build(&input, &mut |_, _| {}).unwrap();
    assert_eq!((told.nodes, told.cells), (looked.nodes, looked.cells));
    for (told, looked) in told.regions.iter().zip(&looked.regions) {
        assert!((told.volume_mm3 / looked.volume_mm3 - 1.0).abs() < 1e-3);
        let [a, b] = [told, looked].map(|r| r.distance_mean_outside_thin_mm);
        assert!((a - b).abs() < 0.02, "{a} {b}");
    }
}

#[test]
fn labels_and_surfaces_mix_with_later_regions_overriding() {
    let folder = Folder::new();
    folder.write("drum.nii", &drum());
    // A block of 20 mm through the middle of label 2, written as a surface.
    let corner = |c: usize, a: usize| if c >> a & 1 == 1 { 0.01 } else { -0.01 };
    let block = Surface {
        vertices: (0..8)
            .map(|c| Vec3::new(corner(c, 0), corner(c, 1) + 0.02, corner(c, 2) + 0.122))
            .collect(),
        triangles: [
            [0, 2, 3],
            [0, 3, 1],
            [4, 5, 7],
            [4, 7, 6],
            [0, 1, 5],
            [0, 5, 4],
            [2, 6, 7],
            [2, 7, 3],
            [0, 4, 6],
            [0, 6, 2],
            [1, 3, 7],
            [1, 7, 5],
        ]
        .to_vec(),
    };
    block.write_stl(&folder.path().join("block.stl")).unwrap();
    let text = drum_scene(&[
        ("skin", "label = 1"),
        ("muscle", "label = 2"),
        ("block", "surface = \"block.stl\""),
        ("bone", "label = 3"),
    ]);
    let (input, report) = built(&folder, &text);
    assert!(input.voxels_m3.iter().all(Option::is_none));
    let volume = |r: usize| report.regions[r].volume_mm3;
    // The bone reaches into the block and overrides it.
    assert!(volume(2) < 7_900.0 && volume(2) > 6_500.0, "{}", volume(2));
    let bone = std::f64::consts::PI * 12.0 * 12.0 * 48.0;
    assert!((volume(3) / bone - 1.0).abs() < 0.03, "{}", volume(3));
    for region in &report.regions {
        let part = region.volume_mm3 / region.input_volume_mm3;
        assert!((part - 1.0).abs() < 0.02, "{}: {part}", region.name);
    }
}

#[test]
fn label_volume_errors_name_the_file() {
    let folder = Folder::new();
    folder.write("drum.nii", &drum());
    let scene = folder.write("s.toml", drum_scene(&[("a", "label = 9")]).as_bytes());
    let message = SceneInput::load(&scene).unwrap_err().to_string();
    for word in ["drum.nii", "label 9 does not occur", "1, 2, 3"] {
        assert!(message.contains(word), "{message}");
    }
    folder.write("drum.nii", &drum()[..5000]);
    let scene = folder.write("s.toml", drum_scene(&[("a", "label = 1")]).as_bytes());
    let message = SceneInput::load(&scene).unwrap_err().to_string();
    assert!(
        message.contains("drum.nii") && message.contains("4648 of 38400 voxels"),
        "{message}"
    );
}

/// Builds a real body and compares with its voxels; needs `PALPATE_DATA`.
fn real(folder: &str, volume: &str, labels: u16, spacing_mm: f64) -> Option<BuildReport> {
    let data = std::env::var_os("PALPATE_DATA")?;
    let data = std::fs::canonicalize(Path::new(&data).join(folder)).unwrap();
    let mut text = format!(
        "format = \"palpate-scene/1\"\nspacing_mm = {spacing_mm:?}\nlabels = '{}'\n",
        data.join(volume).display()
    );
    for label in 1..=labels {
        let name = format!("name = \"l{label}\"\nlabel = {label}");
        writeln!(text, "[[region]]\n{name}\nmaterial = \"fat\"").unwrap();
    }
    let scene = Scene::parse(&text, Path::new("")).unwrap();
    let scratch = Folder::new();
    let path = scratch.write("scene.toml", scene.to_toml().as_bytes());
    let input = SceneInput::load(&path).unwrap();
    Some(build(&input, &mut |_, _| {}).unwrap().1)
}

fn assert_volumes(report: &BuildReport, first: usize) {
    assert!(report.outer_surface.closed);
    for region in &report.regions[first..] {
        let part = region.volume_mm3 / region.input_volume_mm3;
        assert!((part - 1.0).abs() < 0.01, "{}: {part}", region.name);
    }
}

/// Outside of the parts reported as thin, surfaces are in the right position.
fn assert_distances(report: &BuildReport) {
    for region in &report.regions {
        let mean = region.distance_mean_outside_thin_mm;
        assert!(mean <= 0.1 * report.spacing_mm, "{}: {mean}", region.name);
        let most = region.distance_max_outside_thin_mm;
        assert!(most <= 0.75 * report.spacing_mm, "{}: {most}", region.name);
    }
}

#[test]
fn real_legs_keep_label_volumes_within_1_percent() {
    for volume in ["thigh_labels_2mm.nii.gz", "shank_labels_2mm.nii.gz"] {
        for spacing_mm in [4.0, 3.0] {
            if let Some(report) = real("leg_bp3d", volume, 3, spacing_mm) {
                assert_volumes(&report, 0);
                assert_distances(&report);
            }
        }
    }
}

#[test]
fn real_slab_of_ten_organs_builds_from_labels() {
    // The first region is a skin one voxel thick.
    for spacing_mm in [3.0, 4.0] {
        let report = real(
            "abdomen_ct",
            "abdomen_slab_organs_3mm.nii.gz",
            10,
            spacing_mm,
        );
        if let Some(report) = report {
            assert_volumes(&report, 0);
            assert_distances(&report);
            assert_eq!(report.regions[0].components, 1);
        }
    }
}

#[test]
fn real_torso_builds_from_labels() {
    let Some(report) = real("abdomen_ct", "torso_tissue_3mm.nii.gz", 5, 3.0) else {
        return;
    };
    assert_volumes(&report, 0);
    assert_eq!(report.regions[0].components, 1, "the skin");
    assert_eq!(report.quality.inverted_cells, 0);
    assert_distances(&report);
}

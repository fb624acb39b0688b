//! Reading label volumes: accepted files, rejected files and the texts of the errors.

#![allow(clippy::unwrap_used)]

mod label_files;

use std::path::Path;

use label_files::{Folder, Nifti, gzip, nrrd, ramp, space};
use palpate_anatomy::InputError;
use palpate_anatomy::labels::{LabelVolume, VOXELS_MAX};
use palpate_anatomy::{Unit, labels};
use palpate_tissue::Vec3;
use proptest::prelude::*;

fn read(name: &str, bytes: &[u8]) -> Result<LabelVolume, InputError> {
    LabelVolume::read(&Folder::new().write(name, bytes))
}

fn refusal(name: &str, bytes: &[u8]) -> String {
    read(name, bytes).unwrap_err().to_string()
}

fn assert_says(text: &str, words: &[&str]) {
    for word in words {
        assert!(text.contains(word), "{word:?} is not in: {text}");
    }
}

fn assert_ramp(volume: &LabelVolume) {
    assert_eq!(volume.size, [3, 2, 2]);
    assert_eq!(volume.labels, (0..12).collect::<Vec<u16>>());
}

fn assert_at(volume: &LabelVolume, index: [f64; 3], mm: [f64; 3]) {
    let at = volume.to_world.world(&Vec3::from(index)) * 1e3;
    assert!((at - Vec3::from(mm)).norm() < 1e-4, "{at} is not {mm:?}");
}

#[test]
fn nifti_labels_are_equal_for_every_number_type_and_byte_order() {
    type Sample = fn(u8) -> Vec<u8>;
    let types: [(i16, Sample); 10] = [
        (2, |v| vec![v]),
        (256, |v| vec![v]),
        (4, |v| i16::from(v).to_le_bytes().into()),
        (512, |v| u16::from(v).to_le_bytes().into()),
        (8, |v| i32::from(v).to_le_bytes().into()),
        (768, |v| u32::from(v).to_le_bytes().into()),
        (1024, |v| i64::from(v).to_le_bytes().into()),
        (1280, |v| u64::from(v).to_le_bytes().into()),
        (16, |v| f32::from(v).to_le_bytes().into()),
        (64, |v| f64::from(v).to_le_bytes().into()),
    ];
    for (code, sample) in types {
        for big_endian in [false, true] {
            let file = Nifti::in_order(code, big_endian, sample).file();
            assert_ramp(&read("a.nii", &file).unwrap());
            let volume = read("a.nii.gz", &gzip(&file)).unwrap();
            assert_ramp(&volume);
            assert_at(&volume, [1.0, 1.0, 1.0], [52.0, -57.0, 74.0]);
            assert!(volume.warnings.is_empty());
        }
    }
}

#[test]
fn sform_precedes_qform_precedes_voxel_sizes() {
    let mut file = Nifti::bytes();
    file.short(252, 1);
    assert_at(
        &read("a.nii", &file.file()).unwrap(),
        [0.0; 3],
        [50.0, -60.0, 70.0],
    );
    // Half a turn about z, with the third axis mirrored.
    file.short(254, 0).float(264, 1.0).float(76, -1.0);
    for (i, x) in [10.0, 20.0, 30.0].into_iter().enumerate() {
        file.float(268 + 4 * i, x);
    }
    let volume = read("a.nii", &file.file()).unwrap();
    assert_at(&volume, [0.0; 3], [10.0, 20.0, 30.0]);
    assert_at(&volume, [1.0, 1.0, 1.0], [8.0, 17.0, 26.0]);
    file.short(252, 0);
    let volume = read("a.nii", &file.file()).unwrap();
    assert_at(&volume, [1.0, 1.0, 1.0], [2.0, 3.0, 4.0]);
    assert_says(&volume.warnings[0], &["orientation"]);
}

#[test]
fn header_units_are_applied() {
    let mut file = Nifti::bytes();
    file.header[123] = 3;
    // Micrometres: a body of 6 x 6 x 8 of them is implausible.
    assert_says(&refusal("a.nii", &file.file()), &["0.006 x", "metres"]);
    file.header[123] = 1;
    assert_says(
        &refusal("a.nii", &file.file()),
        &["8000.000 mm", "millimetres under a header that says metres"],
    );
    file.header[123] = 0;
    assert_at(
        &read("a.nii", &file.file()).unwrap(),
        [0.0; 3],
        [50.0, -60.0, 70.0],
    );
}

#[test]
fn slope_and_intercept_are_applied_and_zero_slope_is_ignored() {
    let mut file = Nifti::bytes();
    file.float(112, 2.0).float(116, 1.0);
    let volume = read("a.nii", &file.file()).unwrap();
    assert_eq!(volume.labels[..3], [1, 3, 5]);
    file.float(112, 0.0);
    assert_ramp(&read("a.nii", &file.file()).unwrap());
}

#[test]
fn fourth_axis_is_accepted_with_one_entry_only() {
    let mut file = Nifti::bytes();
    file.dims(&[5, 3, 2, 2, 1, 1, 1, 1]);
    assert_ramp(&read("a.nii", &file.file()).unwrap());
    file.dims(&[4, 3, 2, 1, 2, 1, 1, 1]);
    assert_says(
        &refusal("a.nii", &file.file()),
        &["4 axes", "fourth has 2 entries"],
    );
}

#[test]
fn nifti_header_errors_name_the_field() {
    type Change = fn(&mut Nifti);
    let mistakes: [(Change, &[&str]); 14] = [
        (|f| _ = f.short(70, 128), &["colours", "whole numbers"]),
        (|f| _ = f.short(70, 32), &["complex"]),
        (|f| _ = f.short(70, 999), &["datatype 999"]),
        (|f| _ = f.short(72, 16), &["bitpix", "16 bits"]),
        (|f| _ = f.short(40, 9), &["dim[0]", "9 axes"]),
        (|f| _ = f.short(42, -3), &["dim[1]", "-3"]),
        (|f| _ = f.float(108, 1e9), &["vox_offset", "1000000000"]),
        (|f| _ = f.float(108, f32::NAN), &["vox_offset"]),
        (
            |f| f.header[344..348].copy_from_slice(b"ni1\0"),
            &["pair of files"],
        ),
        (|f| _ = f.put(0, &540_i32.to_le_bytes()), &["NIfTI-2"]),
        (|f| _ = f.float(280, 0.0), &["sform", "first axis is zero"]),
        (|f| _ = f.float(280, f32::INFINITY), &["sform", "infinite"]),
        (
            |f| _ = f.float(284, 3.0).float(300, 0.0),
            &["sform", "singular"],
        ),
        (
            |f| {
                _ = f
                    .short(254, 0)
                    .short(252, 1)
                    .float(256, 0.9)
                    .float(260, 0.9);
            },
            &["qform", "not normalised", "1.27"],
        ),
    ];
    for (change, words) in mistakes {
        let mut file = Nifti::bytes();
        change(&mut file);
        assert_says(&refusal("a.nii", &file.file()), words);
    }
    assert_says(&refusal("a.nii", b"not at all"), &["ends after 10 bytes"]);
    assert_says(&refusal("a.nii", &[7; 400]), &["not a NIfTI file"]);
    assert_says(
        &refusal("a.vtk", &[7; 400]),
        &["extension", ".nii.gz", ".nrrd"],
    );
}

#[test]
fn invalid_label_is_rejected_with_its_voxel() {
    let half = Nifti::new(16, |v| (f32::from(v) / 4.0).to_le_bytes().into());
    assert_says(
        &refusal("a.nii", &half.file()),
        &["voxel (1, 0, 0)", "0.25"],
    );
    let negative = Nifti::new(4, |v| (4 - i16::from(v)).to_le_bytes().into());
    assert_says(
        &refusal("a.nii", &negative.file()),
        &["voxel (2, 1, 0)", "-1"],
    );
    let nan = Nifti::new(64, |_| f64::NAN.to_le_bytes().into());
    assert_says(&refusal("a.nii", &nan.file()), &["voxel (0, 0, 0)", "NaN"]);
    let large = Nifti::new(8, |v| (65530 + i32::from(v)).to_le_bytes().into());
    assert_says(&refusal("a.nii", &large.file()), &["65536"]);
}

#[test]
fn oversized_header_is_rejected_before_allocation() {
    let mut file = Nifti::bytes();
    file.dims(&[3, 600, 600, 700, 1, 1, 1, 1]);
    assert_says(&refusal("a.nii", &file.file()), &["12 of 252000000 voxels"]);
    assert_says(
        &refusal("a.nii.gz", &gzip(&file.file())),
        &["12 of 252000000"],
    );
    file.dims(&[3, 30000, 30000, 30000, 1, 1, 1, 1]);
    assert_says(
        &refusal("a.nii", &file.file()),
        &["30000 x 30000 x 30000", &VOXELS_MAX.to_string()],
    );
}

#[test]
fn damaged_gzip_is_rejected_with_the_voxel_count() {
    let whole = gzip(&Nifti::bytes().file());
    for length in 20..whole.len() {
        assert!(
            read("a.nii.gz", &whole[..length]).is_err(),
            "{length} bytes"
        );
    }
    let text = refusal("a.nii.gz", &whole[..whole.len() - 9]);
    assert_says(&text, &["voxels", "again"]);
    let mut wrong_sum = whole.clone();
    let at = wrong_sum.len() - 7;
    wrong_sum[at] ^= 1;
    assert_says(&refusal("a.nii.gz", &wrong_sum), &["12 of 12 voxels"]);
}

#[test]
fn nrrd_labels_are_equal_for_every_encoding() {
    let fields = space("right-anterior-superior");
    let text: Vec<String> = ramp().iter().map(u8::to_string).collect();
    let text = text.join(" \n");
    let packed = gzip(&ramp());
    let data = [
        ("raw", ramp()),
        ("gzip", packed),
        ("ascii", text.into_bytes()),
    ];
    for (encoding, data) in data {
        let volume = read("a.nrrd", &nrrd(encoding, &fields, &data)).unwrap();
        assert_ramp(&volume);
        assert_at(&volume, [1.0, 1.0, 1.0], [52.0, -57.0, 74.0]);
        let folder = Folder::new();
        folder.write("my data.bin", &data);
        let header = nrrd(encoding, &format!("{fields}data file: my data.bin\n"), &[]);
        assert_ramp(&LabelVolume::read(&folder.write("a.nhdr", &header)).unwrap());
    }
}

#[test]
fn nrrd_lps_and_las_are_converted_to_ras() {
    for (name, x, y) in [
        ("left-posterior-superior", -1.0, -1.0),
        ("LAS", -1.0, 1.0),
        ("right-anterior-superior", 1.0, 1.0),
    ] {
        let volume = read("a.nrrd", &nrrd("raw", &space(name), &ramp())).unwrap();
        assert_at(&volume, [1.0, 1.0, 1.0], [52.0 * x, -57.0 * y, 74.0]);
    }
}

#[test]
fn nrrd_line_skip_byte_skip_and_byte_order_are_applied() {
    let fields = format!("{}line skip: 2\nbyte skip: 3\n", space("RAS"));
    let data = [b"one\ntwo\nxyz".as_slice(), &ramp()].concat();
    assert_ramp(&read("a.nrrd", &nrrd("raw", &fields, &data)).unwrap());
    let fields = format!("{}byteskip: -1\n", space("RAS"));
    assert_ramp(&read("a.nrrd", &nrrd("raw", &fields, &data)).unwrap());
    let big: Vec<u8> = (0..12_u16).flat_map(u16::to_be_bytes).collect();
    let text = nrrd("raw", &format!("{}endian: big\n", space("RAS")), &big);
    let text = String::from_utf8_lossy(&text).replace("uchar", "unsigned short");
    assert_ramp(&read("a.nrrd", text.as_bytes()).unwrap());
}

#[test]
fn surplus_data_is_reported_and_missing_data_rejected() {
    let surplus = [ramp(), vec![0; 5]].concat();
    for (name, bytes) in [
        ("a.nrrd", nrrd("raw", &space("RAS"), &surplus)),
        ("a.nii", [Nifti::bytes().file(), vec![0; 5]].concat()),
    ] {
        let volume = read(name, &bytes).unwrap();
        assert_ramp(&volume);
        assert!(
            volume.warnings.iter().any(|w| w.contains("5 bytes behind")),
            "{:?}",
            volume.warnings
        );
    }
    // Counted from the end the data would begin within the header.
    let fields = format!("{}byteskip: -1\n", space("RAS"));
    let short = nrrd("raw", &fields, &ramp()[..7]);
    assert_says(&refusal("a.nrrd", &short), &["12"]);
}

#[test]
fn nrrd_non_spatial_axes_must_have_one_entry() {
    let file = |sizes: &str| {
        let fields = "space: RAS\nspace directions: none (2,0,0) (0,3,0) (0,0,4)\n";
        let text = String::from_utf8(nrrd("raw", fields, &ramp())).unwrap();
        text.replace("dimension: 3", "dimension: 4")
            .replace("3 2 2", sizes)
    };
    assert_ramp(&read("a.nrrd", file("1 3 2 2").as_bytes()).unwrap());
    let text = refusal("a.nrrd", file("3 2 2 1").as_bytes());
    assert_says(&text, &["axis 1 with 3 entries", "several"]);
}

#[test]
fn nrrd_header_errors_name_the_line() {
    let mistakes: [(&str, &str, &[&str]); 13] = [
        ("uchar", "block", &["\"block\"", "whole numbers"]),
        ("uchar", "short", &["endian", "missing"]),
        (
            "dimension: 3",
            "dimension: 99",
            &["dimension (line 4)", "99"],
        ),
        (
            "dimension: 3",
            "dimension: three",
            &["dimension", "\"three\""],
        ),
        (
            "sizes: 3 2 2",
            "sizes: 3 2",
            &["sizes (line 5)", "2 numbers for 3 axes"],
        ),
        ("sizes: 3 2 2", "sizes: 3 2 -2", &["sizes", "\"-2\""]),
        ("sizes: 3 2 2", "sizes: 3 0 2", &["3 x 0 x 2"]),
        ("raw", "bzip2", &["encoding", "\"bzip2\"", "gzip"]),
        (
            "space: RAS",
            "space: sideways",
            &["space", "\"sideways\"", "LPS"],
        ),
        ("(0,3,0)", "(0,3)", &["space directions", "(x,y,z)"]),
        ("(0,3,0)", "(2,0,0)", &["singular"]),
        ("NRRD", "XRRD", &["not an NRRD file"]),
        ("sizes: 3 2 2", "sizes 3 2 2", &["line 5", "no field"]),
    ];
    let good = String::from_utf8(nrrd("raw", &space("RAS"), &ramp())).unwrap();
    assert_ramp(&read("a.nrrd", good.as_bytes()).unwrap());
    for (what, by, words) in mistakes {
        assert!(good.contains(what));
        assert_says(
            &refusal("a.nrrd", good.replacen(what, by, 1).as_bytes()),
            words,
        );
    }
    let short = &good.as_bytes()[..good.len() - 4];
    assert_says(&refusal("a.nrrd", short), &["8 of 12 voxels"]);
    let words = nrrd("ascii", &space("RAS"), b"0 1 2 x3 4");
    assert_says(&refusal("a.nrrd", &words), &["number 4", "\"x3\""]);
    let gone = nrrd("raw", "data file: gone.raw\n", &[]);
    assert_says(&refusal("a.nhdr", &gone), &["gone.raw", "check the path"]);
}

#[cfg(not(feature = "dicom"))]
#[test]
fn dicom_series_error_names_the_missing_feature() {
    let folder = Folder::new();
    let text = LabelVolume::read(folder.path()).unwrap_err().to_string();
    assert_says(&text, &["--features dicom", "NIfTI"]);
}

#[test]
fn counts_and_bounds_match_the_voxels() {
    let volume = read("a.nii", &Nifti::bytes().file()).unwrap();
    assert_eq!(volume.counts().len(), 12);
    assert!((volume.voxel_m3() - 24e-9).abs() < 1e-18);
    let bounds = volume.world_bounds();
    let mm = |p: Vec3| p * 1e3;
    assert!((mm(bounds.min) - Vec3::new(49.0, -61.5, 68.0)).norm() < 1e-4);
    assert!((mm(bounds.max) - Vec3::new(55.0, -55.5, 76.0)).norm() < 1e-4);
}

/// Labels of a real leg lie where its surfaces do; needs `PALPATE_DATA`.
#[test]
fn real_labels_and_surfaces_of_one_body_coincide() {
    let Some(data) = std::env::var_os("PALPATE_DATA") else {
        return;
    };
    let leg = Path::new(&data).join("leg_bp3d");
    for (part, label, surface) in [("thigh", 3, "thigh_femur"), ("shank", 3, "shank_tibia")] {
        let path = leg.join(format!("{part}_labels_2mm.nii.gz"));
        let volume = LabelVolume::read(&path).unwrap();
        let regions = [labels::LabelRegion {
            labels: vec![label],
        }];
        let found = labels::surfaces(&volume, &path, &regions, false, 0.0).unwrap();
        let file = leg.join(format!("{surface}.stl"));
        let surface = palpate_anatomy::Surface::read(&file, Unit::default()).unwrap();
        let own = found[0].surface.aabb().unwrap();
        let given = surface.aabb().unwrap();
        // The shank's label includes the fibula, so its box may only be larger.
        assert!(
            (own.max.x - given.max.x).abs() < 2.5e-3 && (own.max.z - given.max.z).abs() < 2.5e-3
        );
        assert!(
            (own.max.y - given.max.y).abs() < 2.5e-3 && (own.min.z - given.min.z).abs() < 2.5e-3
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn flipped_bits_and_cuts_never_panic(
        which in 0_usize..5,
        flips in prop::collection::vec((any::<prop::sample::Index>(), 0_u8..8), 0..6),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let (name, mut bytes) = match which {
            0 => ("a.nii", Nifti::bytes().file()),
            1 => ("a.nii.gz", gzip(&Nifti::bytes().file())),
            2 => ("a.nrrd", nrrd("raw", &space("LPS"), &ramp())),
            3 => ("a.nrrd", nrrd("gzip", &space("LPS"), &gzip(&ramp()))),
            _ => ("a.nrrd", nrrd("ascii", &space("LPS"), b"0 1 2 3 4 5 6 7 8 9 10 11")),
        };
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        if let Some(at) = cut {
            bytes.truncate(at.index(bytes.len()));
        }
        if let Ok(volume) = read(name, &bytes) {
            prop_assert_eq!(volume.labels.len(), volume.size.iter().product::<usize>());
        }
    }
}

//! DICOM series as label volumes (feature `dicom`): files written element by element.

#![cfg(feature = "dicom")]
#![allow(clippy::unwrap_used)]

mod label_files;

use label_files::Folder;
use palpate_anatomy::InputError;
use palpate_anatomy::labels::LabelVolume;
use palpate_tissue::Vec3;

/// An element in explicit VR, little endian; values of odd length are padded.
fn element(tag: (u16, u16), vr: [u8; 2], value: &[u8]) -> Vec<u8> {
    let mut value = value.to_vec();
    if value.len() % 2 == 1 {
        value.push(if [*b"UI", *b"OB"].contains(&vr) {
            0
        } else {
            b' '
        });
    }
    let mut bytes = [tag.0.to_le_bytes(), tag.1.to_le_bytes()].concat();
    bytes.extend(vr);
    if [*b"OB", *b"OW", *b"SQ"].contains(&vr) {
        bytes.extend([0, 0]);
        bytes.extend((value.len() as u32).to_le_bytes());
    } else {
        bytes.extend((value.len() as u16).to_le_bytes());
    }
    bytes.extend(value);
    bytes
}

fn sequence(tag: (u16, u16), items: &[Vec<u8>]) -> Vec<u8> {
    let items = items.iter().map(|item| {
        let mut bytes = vec![0xfe, 0xff, 0x00, 0xe0];
        bytes.extend((item.len() as u32).to_le_bytes());
        bytes.extend(item);
        bytes
    });
    element(tag, *b"SQ", &items.collect::<Vec<_>>().concat())
}

/// One image of 3 columns and 2 rows of 2 x 3 mm.
#[derive(Clone)]
struct Image {
    syntax: &'static str,
    series: &'static str,
    position: Option<[f64; 3]>,
    orientation: &'static str,
    bits: u16,
    /// Elements of a group above 0028, before the pixels, in ascending order.
    more: Vec<u8>,
    frames: usize,
    pixels: Vec<u16>,
}

impl Image {
    fn at(z: f64, first: u16) -> Self {
        Self {
            syntax: "1.2.840.10008.1.2.1",
            series: "1.2.3",
            position: Some([10.0, 20.0, z]),
            orientation: "1\\0\\0\\0\\1\\0",
            bits: 16,
            more: Vec::new(),
            frames: 1,
            pixels: (first..first + 6).collect(),
        }
    }

    fn file(&self) -> Vec<u8> {
        let meta = [
            element((2, 1), *b"OB", &[0, 1]),
            element((2, 2), *b"UI", b"1.2.840.10008.5.1.4.1.1.7"),
            element((2, 3), *b"UI", b"1.2.3.4"),
            element((2, 0x10), *b"UI", self.syntax.as_bytes()),
            element((2, 0x12), *b"UI", b"1.2.3.5"),
        ]
        .concat();
        let whole = |n: u16| n.to_le_bytes();
        let mut file = vec![0; 128];
        file.extend(b"DICM");
        file.extend(element((2, 0), *b"UL", &(meta.len() as u32).to_le_bytes()));
        file.extend(meta);
        file.extend(element((0x08, 0x16), *b"UI", b"1.2.840.10008.5.1.4.1.1.7"));
        file.extend(element((0x18, 0x50), *b"DS", b"4.0"));
        file.extend(element((0x20, 0x0e), *b"UI", self.series.as_bytes()));
        if let Some([x, y, z]) = self.position {
            let text = format!("{x}\\{y}\\{z}");
            file.extend(element((0x20, 0x32), *b"DS", text.as_bytes()));
            file.extend(element((0x20, 0x37), *b"DS", self.orientation.as_bytes()));
        }
        file.extend(element((0x28, 0x02), *b"US", &whole(1)));
        if self.frames > 1 {
            let frames = self.frames.to_string();
            file.extend(element((0x28, 0x08), *b"IS", frames.as_bytes()));
        }
        file.extend(element((0x28, 0x10), *b"US", &whole(2)));
        file.extend(element((0x28, 0x11), *b"US", &whole(3)));
        file.extend(element((0x28, 0x30), *b"DS", b"3.0\\2.0"));
        file.extend(element((0x28, 0x100), *b"US", &whole(self.bits)));
        file.extend(element((0x28, 0x103), *b"US", &whole(0)));
        file.extend(&self.more);
        let words: Vec<u8> = self.pixels.iter().flat_map(|p| p.to_le_bytes()).collect();
        file.extend(element((0x7fe0, 0x10), *b"OW", &words));
        file
    }
}

fn series(images: &[Image]) -> Result<LabelVolume, InputError> {
    let folder = Folder::new();
    folder.write("notes.txt", b"not an image");
    for (n, image) in images.iter().enumerate() {
        folder.write(&format!("{n}.dcm"), &image.file());
    }
    LabelVolume::read(folder.path())
}

fn refusal(images: &[Image]) -> String {
    series(images).unwrap_err().to_string()
}

fn assert_at(volume: &LabelVolume, index: [f64; 3], mm: [f64; 3]) {
    let at = volume.to_world.world(&Vec3::from(index)) * 1e3;
    assert!((at - Vec3::from(mm)).norm() < 1e-6, "{at} is not {mm:?}");
}

#[test]
fn slices_are_sorted_by_position_and_converted_to_ras() {
    // Files in the wrong order; DICOM coordinates are LPS.
    let volume = series(&[Image::at(38.0, 12), Image::at(30.0, 0), Image::at(34.0, 6)]).unwrap();
    assert_eq!(volume.size, [3, 2, 3]);
    assert_eq!(volume.labels, (0..18).collect::<Vec<u16>>());
    assert_at(&volume, [0.0; 3], [-10.0, -20.0, 30.0]);
    assert_at(&volume, [1.0, 1.0, 1.0], [-12.0, -23.0, 34.0]);
}

#[test]
fn multi_frame_positions_come_per_frame_or_from_thickness() {
    let mut image = Image::at(30.0, 0);
    image.frames = 2;
    image.pixels = (0..12).collect();
    let folder = Folder::new();
    let volume = LabelVolume::read(&folder.write("a.dcm", &image.file())).unwrap();
    assert_eq!(volume.labels, (0..12).collect::<Vec<u16>>());
    assert_at(&volume, [0.0, 0.0, 1.0], [-10.0, -20.0, 34.0]);

    // The frames are ordered from top to bottom here.
    let place = |z: f64| {
        let text = format!("10\\20\\{z}");
        let position = element((0x20, 0x32), *b"DS", text.as_bytes());
        sequence((0x20, 0x9113), &[position])
    };
    let orientation = element((0x20, 0x37), *b"DS", b"1\\0\\0\\0\\1\\0");
    let shared = sequence((0x20, 0x9116), &[orientation]);
    image.position = None;
    image.more = [
        sequence((0x5200, 0x9229), &[shared]),
        sequence((0x5200, 0x9230), &[place(35.0), place(30.0)]),
    ]
    .concat();
    let volume = LabelVolume::read(&folder.write("b.dcm", &image.file())).unwrap();
    assert_eq!(volume.labels[..6], [6, 7, 8, 9, 10, 11]);
    assert_at(&volume, [0.0, 0.0, 1.0], [-10.0, -20.0, 35.0]);
}

type Change = fn(&mut Image);

#[test]
fn invalid_series_is_rejected_with_the_place() {
    let good = [Image::at(30.0, 0), Image::at(34.0, 6), Image::at(38.0, 12)];
    let with = |change: &dyn Fn(&mut Image)| {
        let mut images = good.clone();
        change(&mut images[1]);
        refusal(&images)
    };
    let mistakes: [(Change, &[&str]); 8] = [
        (|i| i.series = "9.9", &["series", "1.dcm"]),
        (
            |i| i.position = Some([10.0, 20.0, 36.5]),
            &["evenly spaced", "6.500 mm"],
        ),
        (|i| i.position = Some([10.0, 20.0, 30.0]), &["one place"]),
        (|i| i.position = None, &["1.dcm", "missing"]),
        (
            |i| i.orientation = "0\\1\\0\\1\\0\\0",
            &["orientation", "1.dcm"],
        ),
        (|i| i.bits = 1, &["of 1 bits", "1.dcm"]),
        (|i| i.pixels.truncate(4), &["pixel data", "1.dcm"]),
        (
            |i| i.syntax = "1.2.840.10008.1.2.4.90",
            &["compressed", "1.dcm"],
        ),
    ];
    for (change, words) in mistakes {
        let message = with(&change);
        for word in words {
            assert!(message.contains(word), "{message} (no {word})");
        }
    }
    let folder = Folder::new();
    folder.write("notes.txt", b"not an image");
    let message = LabelVolume::read(folder.path()).unwrap_err().to_string();
    assert!(
        message.contains("no file in this folder is DICOM"),
        "{message}"
    );
}

#[test]
fn damaged_files_never_panic() {
    let whole = Image::at(30.0, 0).file();
    let folder = Folder::new();
    for at in 0..whole.len() {
        let _ = LabelVolume::read(&folder.write("a.dcm", &whole[..at]));
        let mut flipped = whole.clone();
        flipped[at] ^= 1 << (at % 8);
        let _ = LabelVolume::read(&folder.write("a.dcm", &flipped));
    }
}

//! DICOM series whose images are labels: a folder of single frames, or one multi-frame file.
//!
//! A first pass reads the headers and the positions of the slices, a second one the pixels, one file at a time.
//! Pixels must be uncompressed. The tags are those of PS3.3, C.7.6.2 (image plane) and C.7.6.16 (functional
//! groups).

mod lengths;

use std::path::{Path, PathBuf};

use dicom_object::{InMemDicomObject, OpenFileOptions, Tag};
use nalgebra::Matrix3;
use palpate_tissue::Vec3;

use crate::InputError;
use crate::labels::samples::{Coding, Gather, SampleType};
use crate::labels::volume::{
    bad_orientation, broken, checked_size, not_labels, not_one_volume, not_whole,
};
use crate::labels::{Affine, LabelVolume};

/// Most files of a folder that are read. Reason: a whole body at 1 mm has 2000 slices. Beyond the bound the
/// folder is rejected.
const FILES_MAX: usize = 20_000;

/// Largest difference between distances of slices, relative to their mean. Reason: positions are written with a
/// hundredth of a millimetre, and a missing slice is a whole step.
const GAP_MAX: f64 = 0.05;

/// Largest difference between directions (cosines) or voxel sizes (mm) of slices of one series.
const SAME: f64 = 1e-3;

const SEGMENTATION_TYPE: Tag = Tag(0x0062, 0x0001);
const SERIES: Tag = Tag(0x0020, 0x000e);
const SAMPLES_PER_PIXEL: Tag = Tag(0x0028, 0x0002);
const FRAMES: Tag = Tag(0x0028, 0x0008);
const ROWS: Tag = Tag(0x0028, 0x0010);
const COLUMNS: Tag = Tag(0x0028, 0x0011);
const PIXEL_SPACING: Tag = Tag(0x0028, 0x0030);
const BITS_ALLOCATED: Tag = Tag(0x0028, 0x0100);
const PIXEL_SIGN: Tag = Tag(0x0028, 0x0103);
const INTERCEPT: Tag = Tag(0x0028, 0x1052);
const SLOPE: Tag = Tag(0x0028, 0x1053);
const THICKNESS: Tag = Tag(0x0018, 0x0050);
const SLICE_SPACING: Tag = Tag(0x0018, 0x0088);
const POSITION: Tag = Tag(0x0020, 0x0032);
const ORIENTATION: Tag = Tag(0x0020, 0x0037);
const SHARED_GROUPS: Tag = Tag(0x5200, 0x9229);
const FRAME_GROUPS: Tag = Tag(0x5200, 0x9230);
const PLANE_POSITION: Tag = Tag(0x0020, 0x9113);
const PLANE_ORIENTATION: Tag = Tag(0x0020, 0x9116);
const PIXEL_MEASURES: Tag = Tag(0x0028, 0x9110);
const PIXEL_DATA: Tag = Tag(0x7fe0, 0x0010);

/// Transfer syntaxes whose pixels are plain numbers.
const PLAIN_SYNTAXES: [&str; 3] = [
    "1.2.840.10008.1.2",
    "1.2.840.10008.1.2.1",
    "1.2.840.10008.1.2.2",
];

/// Origin of an orientation in messages.
const FROM: &str = "DICOM headers";

/// Header fields of one file.
#[derive(Debug, Clone)]
struct Header {
    path: PathBuf,
    series: String,
    /// Columns and rows.
    size: [u64; 2],
    sample: SampleType,
    slope: f64,
    intercept: f64,
    /// Steps in mm from a column to the next and from a row to the next, LPS.
    steps: [Vec3; 2],
    /// Middle of the first pixel of each frame in mm, LPS.
    frames: Vec<Vec3>,
    /// Distance of slices in mm, for a series of a single one.
    thickness: Option<f64>,
}

/// A frame of a file.
struct Slice {
    file: usize,
    frame: usize,
    at: Vec3,
}

/// Reads a folder, or one file.
pub(super) fn read(path: &Path) -> Result<LabelVolume, InputError> {
    let headers = headers(path)?;
    refuse_mixtures(path, &headers)?;
    let first = &headers[0];
    let slices = sorted(&headers);
    let [columns, rows] = first.size;
    let size = checked_size(path, [columns, rows, slices.len() as u64])?;
    let along = slice_step(path, first, &slices)?;
    // Patient coordinates of DICOM are LPS.
    let to_ras = |p: Vec3| Vec3::new(-p.x, -p.y, p.z) * 1e-3;
    let columns = [first.steps[0], first.steps[1], along].map(to_ras);
    let to_world = Affine {
        linear: Matrix3::from_columns(&columns),
        origin: to_ras(slices[0].at),
    }
    .checked(path, FROM)?;
    Ok(LabelVolume {
        size,
        labels: pixels(path, size, &headers, &slices)?,
        to_world,
        warnings: Vec::new(),
    })
}

/// The headers of all DICOM files of a folder, by name; other files are skipped.
fn headers(path: &Path) -> Result<Vec<Header>, InputError> {
    if !path.is_dir() {
        return Ok(vec![Header::read(path)?]);
    }
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(InputError::io(path))? {
        let file = entry.map_err(InputError::io(path))?.path();
        if file.is_file() {
            files.push(file);
        }
        if files.len() > FILES_MAX {
            return Err(not_one_volume(path, format!("more than {FILES_MAX} files")));
        }
    }
    files.sort();
    let mut headers = Vec::new();
    for file in files.iter().filter(|f| is_dicom(f)) {
        headers.push(Header::read(file)?);
    }
    if headers.is_empty() {
        return Err(not_labels(path, "no file in this folder is DICOM"));
    }
    Ok(headers)
}

/// Whether the DICOM mark follows the preamble.
fn is_dicom(path: &Path) -> bool {
    let mut start = [0; 132];
    let read = std::fs::File::open(path)
        .and_then(|mut f| crate::labels::samples::read_fully(&mut f, &mut start));
    read.is_ok_and(|n| n == start.len()) && &start[128..] == b"DICM"
}

impl Header {
    fn read(path: &Path) -> Result<Self, InputError> {
        lengths::check(path).map_err(|e| broken(path, "elements", e))?;
        let object = OpenFileOptions::new()
            .read_until(PIXEL_DATA)
            .open_file(path)
            .map_err(|e| broken(path, "header", e))?;
        let syntax = object
            .meta()
            .transfer_syntax()
            .trim_end_matches(['\0', ' ']);
        if !PLAIN_SYNTAXES.contains(&syntax) {
            let what = format!("pixels are compressed ({syntax}); save the series uncompressed");
            return Err(broken(path, "transfer syntax", what));
        }
        let fields = Fields {
            path,
            object: &object,
        };
        fields.refuse_segments()?;
        let sample = fields.sample()?;
        let shared = item(&object, SHARED_GROUPS);
        let nested = |group: Tag, tag: Tag| -> Option<Vec<f64>> {
            let group = shared.and_then(|s| item(s, group));
            group
                .and_then(|g| numbers(g, tag))
                .or_else(|| numbers(&object, tag))
        };
        let [dy, dx] = nested(PIXEL_MEASURES, PIXEL_SPACING)
            .and_then(|s| <[f64; 2]>::try_from(s).ok())
            .ok_or_else(|| fields.missing("pixel spacing"))?;
        let directions = nested(PLANE_ORIENTATION, ORIENTATION)
            .and_then(|o| <[f64; 6]>::try_from(o).ok())
            .ok_or_else(|| fields.missing("image orientation (patient)"))?;
        let [a, b, c, d, e, f] = directions;
        let steps = [Vec3::new(a, b, c) * dx, Vec3::new(d, e, f) * dy];
        let thickness = nested(PIXEL_MEASURES, SLICE_SPACING)
            .or_else(|| nested(PIXEL_MEASURES, THICKNESS))
            .and_then(|t| t.first().copied())
            .filter(|t| *t > 0.0);
        Ok(Self {
            path: path.to_owned(),
            series: object
                .get(SERIES)
                .and_then(|e| e.to_str().ok())
                .map_or(String::new(), std::borrow::Cow::into_owned),
            size: [
                fields.whole(COLUMNS, "columns")?,
                fields.whole(ROWS, "rows")?,
            ],
            sample,
            slope: numbers(&object, SLOPE).map_or(1.0, |n| n[0]),
            intercept: numbers(&object, INTERCEPT).map_or(0.0, |n| n[0]),
            frames: fields.frames(steps, thickness)?,
            steps,
            thickness,
        })
    }
}

/// The object of a header, for reading fields.
struct Fields<'a> {
    path: &'a Path,
    object: &'a InMemDicomObject,
}

/// The numbers of an element; `None` when it is missing, empty or not numeric.
fn numbers(object: &InMemDicomObject, tag: Tag) -> Option<Vec<f64>> {
    let numbers = object.get(tag)?.to_multi_float64().ok()?;
    (!numbers.is_empty() && numbers.iter().all(|n| n.is_finite())).then_some(numbers)
}

/// The only item of a sequence, or the first.
fn item(of: &InMemDicomObject, tag: Tag) -> Option<&InMemDicomObject> {
    of.get(tag)?.items()?.first()
}

impl Fields<'_> {
    fn missing(&self, name: &str) -> InputError {
        broken(self.path, name, "this attribute is missing or unreadable")
    }

    fn whole(&self, tag: Tag, name: &str) -> Result<u64, InputError> {
        let value = self.object.get(tag).and_then(|e| e.to_int::<u32>().ok());
        value.map(u64::from).ok_or_else(|| self.missing(name))
    }

    /// Segmentation objects hold one mask per segment, not labels, unless they are label maps.
    fn refuse_segments(&self) -> Result<(), InputError> {
        let kind = self.object.get(SEGMENTATION_TYPE);
        let kind = kind.and_then(|e| e.to_str().ok()).unwrap_or_default();
        let kind = kind.trim();
        if kind.is_empty() || kind == "LABELMAP" {
            return Ok(());
        }
        Err(not_whole(
            self.path,
            format!("masks of a segmentation object ({kind}), one per segment"),
        ))
    }

    fn sample(&self) -> Result<SampleType, InputError> {
        let wrong = |what: String| not_whole(self.path, what);
        let samples = self
            .whole(SAMPLES_PER_PIXEL, "samples per pixel")
            .unwrap_or(1);
        if samples != 1 {
            return Err(wrong(format!("colours of {samples} samples")));
        }
        let signed = self.whole(PIXEL_SIGN, "pixel representation").unwrap_or(0) == 1;
        match (self.whole(BITS_ALLOCATED, "bits allocated")?, signed) {
            (8, false) => Ok(SampleType::U8),
            (8, true) => Ok(SampleType::I8),
            (16, false) => Ok(SampleType::U16),
            (16, true) => Ok(SampleType::I16),
            (bits, _) => Err(wrong(format!("of {bits} bits"))),
        }
    }

    /// Where each frame begins.
    fn frames(&self, steps: [Vec3; 2], thickness: Option<f64>) -> Result<Vec<Vec3>, InputError> {
        let position = |of: &InMemDicomObject| match numbers(of, POSITION).as_deref() {
            Some([x, y, z]) => Some(Vec3::new(*x, *y, *z)),
            _ => None,
        };
        let missing = || self.missing("image position (patient)");
        let count = self.whole(FRAMES, "number of frames").unwrap_or(1).max(1) as usize;
        if let Some(items) = self.object.get(FRAME_GROUPS).and_then(|e| e.items()) {
            if items.len() != count {
                let what = format!("{} entries for {count} frames", items.len());
                return Err(broken(self.path, "per-frame functional groups", what));
            }
            let at = |of: &InMemDicomObject| {
                item(of, PLANE_POSITION)
                    .and_then(position)
                    .ok_or_else(missing)
            };
            return items.iter().map(at).collect();
        }
        let first = position(self.object).ok_or_else(missing)?;
        if count == 1 {
            return Ok(vec![first]);
        }
        let thickness = thickness.ok_or_else(|| self.missing("spacing between slices"))?;
        let normal = steps[0]
            .cross(&steps[1])
            .try_normalize(0.0)
            .unwrap_or_default();
        if count > FILES_MAX {
            return Err(broken(self.path, "number of frames", count));
        }
        Ok((0..count)
            .map(|f| first + normal * (thickness * f as f64))
            .collect())
    }
}

fn refuse_mixtures(path: &Path, headers: &[Header]) -> Result<(), InputError> {
    let first = &headers[0];
    for header in headers {
        let differs = |what: &str| {
            not_one_volume(
                path,
                format!(
                    "{} and {} differ in their {what}; keep one series in a folder of its own",
                    first.path.display(),
                    header.path.display()
                ),
            )
        };
        if header.series != first.series {
            return Err(differs("series"));
        }
        if header.size != first.size {
            return Err(differs("rows and columns"));
        }
        if header.sample != first.sample {
            return Err(differs("sample type"));
        }
        if (0..2).any(|a| (header.steps[a] - first.steps[a]).norm() > SAME) {
            return Err(differs("orientation or pixel spacing"));
        }
    }
    Ok(())
}

/// All frames, along the normal of the slices.
fn sorted(headers: &[Header]) -> Vec<Slice> {
    let [across, down] = headers[0].steps;
    let normal = across.cross(&down);
    let mut slices: Vec<Slice> = Vec::new();
    for (file, header) in headers.iter().enumerate() {
        slices.extend(header.frames.iter().enumerate().map(|(frame, at)| Slice {
            file,
            frame,
            at: *at,
        }));
    }
    slices.sort_by(|a, b| normal.dot(&a.at).total_cmp(&normal.dot(&b.at)));
    slices
}

/// The step from a slice to the next in mm; slices must be evenly spaced.
fn slice_step(path: &Path, first: &Header, slices: &[Slice]) -> Result<Vec3, InputError> {
    let normal = first.steps[0].cross(&first.steps[1]);
    let normal = normal
        .try_normalize(0.0)
        .ok_or_else(|| bad_orientation(path, FROM, "rows and columns have one direction"))?;
    if slices.len() == 1 {
        let thickness = first.thickness;
        return thickness
            .map(|t| normal * t)
            .ok_or_else(|| bad_orientation(path, FROM, "one slice, and no thickness of it"));
    }
    let step = (slices[slices.len() - 1].at - slices[0].at) / (slices.len() - 1) as f64;
    let even = step.norm();
    for (n, pair) in slices.windows(2).enumerate() {
        let gap = pair[1].at - pair[0].at;
        if gap.dot(&normal) < SAME {
            let what = format!(
                "slices {n} and {} (frames {} and {}) lie in one place",
                n + 1,
                pair[0].frame,
                pair[1].frame
            );
            return Err(bad_orientation(path, FROM, what));
        }
        if (gap - step).norm() > GAP_MAX * even {
            let what = format!(
                "slices are not evenly spaced: {:.3} mm between {n} and {}, {even:.3} mm on \
                 average; is a slice missing?",
                gap.norm(),
                n + 1
            );
            return Err(bad_orientation(path, FROM, what));
        }
    }
    Ok(step)
}

fn pixels(
    path: &Path,
    size: [usize; 3],
    headers: &[Header],
    slices: &[Slice],
) -> Result<Vec<u16>, InputError> {
    let mut gather = Gather::new(path, size);
    let count = size[0] * size[1];
    let mut open: Option<(usize, Vec<u8>)> = None;
    for slice in slices {
        let header = &headers[slice.file];
        let bytes = match open.take() {
            Some((file, bytes)) if file == slice.file => bytes,
            _ => pixel_bytes(&header.path)?,
        };
        let each = count * header.sample.bytes();
        let frame = bytes.get(slice.frame * each..(slice.frame + 1) * each);
        let mut frame = frame.ok_or_else(|| {
            let what = format!("{} bytes, frame {} needs more", bytes.len(), slice.frame);
            broken(&header.path, "pixel data", what)
        })?;
        // The library returns words in the machine's byte order.
        let coding = Coding {
            slope: header.slope,
            intercept: header.intercept,
            ..Coding::plain(header.sample, cfg!(target_endian = "big"))
        };
        gather.read(&mut frame, coding, count)?;
        open = Some((slice.file, bytes));
    }
    gather.finish()
}

fn pixel_bytes(path: &Path) -> Result<Vec<u8>, InputError> {
    let object = dicom_object::open_file(path).map_err(|e| broken(path, "pixel data", e))?;
    let element = object
        .element(PIXEL_DATA)
        .map_err(|e| broken(path, "pixel data", e))?;
    let bytes = element
        .to_bytes()
        .map_err(|e| broken(path, "pixel data", e))?;
    Ok(bytes.into_owned())
}

//! A label volume in memory, and the choice of the reader for a file.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use palpate_tissue::Vec3;

use super::{Affine, EXTENT_RANGE_M, VOXELS_MAX, nifti, nrrd};
use crate::{Aabb, InputError};

/// Labels listed individually in a message; beyond it the message gives their number.
const NAMED_MAX: usize = 24;

/// An image of labels with its place in the world (RAS, m; see the module).
#[derive(Debug, Clone, PartialEq)]
pub struct LabelVolume {
    /// Voxels along i, j and k.
    pub size: [usize; 3],
    /// The label of each voxel, i fastest.
    pub labels: Vec<u16>,
    /// From voxel indices to the world.
    pub to_world: Affine,
    /// Warnings about the file, one sentence each.
    pub warnings: Vec<String>,
}

impl LabelVolume {
    /// Reads a NIfTI-1 (`.nii`, `.nii.gz`) or NRRD (`.nrrd`, `.nhdr`) file, or a DICOM series (a
    /// folder, or one multi-frame file; needs the feature `dicom`). The extension decides.
    pub fn read(path: &Path) -> Result<Self, InputError> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let name = name.to_lowercase();
        let is = |end: &str| name.ends_with(end);
        let is_folder = std::fs::metadata(path)
            .map_err(InputError::io(path))?
            .is_dir();
        let volume = if is_folder || is(".dcm") || is(".dicom") {
            read_dicom(path)?
        } else if is(".nii") || is(".nii.gz") {
            nifti::read(path)?
        } else if is(".nrrd") || is(".nhdr") {
            nrrd::read(path)?
        } else {
            return Err(not_labels(path, "the extension is unknown"));
        };
        volume.refuse_unlikely_size(path)?;
        Ok(volume)
    }

    /// Number of voxels of each label, by label; labels that do not occur are left out.
    pub fn counts(&self) -> Vec<(u16, u64)> {
        let mut counts = vec![0_u64; usize::from(u16::MAX) + 1];
        for label in &self.labels {
            counts[usize::from(*label)] += 1;
        }
        (0..=u16::MAX)
            .zip(counts)
            .filter(|(_, count)| *count > 0)
            .collect()
    }

    /// Volume of one voxel in m³.
    pub fn voxel_m3(&self) -> f64 {
        self.to_world.determinant().abs()
    }

    /// The box around all voxels (their outer corners, not their middles) in the world, in m.
    pub fn world_bounds(&self) -> Aabb {
        let corners: [Vec3; 8] = std::array::from_fn(|c| {
            let at = |a: usize| {
                if c >> a & 1 == 1 {
                    self.size[a] as f64
                } else {
                    0.0
                }
            };
            self.to_world
                .world(&(Vec3::new(at(0), at(1), at(2)) - Vec3::repeat(0.5)))
        });
        let none = Aabb {
            min: Vec3::zeros(),
            max: Vec3::zeros(),
        };
        Aabb::around(&corners).unwrap_or(none)
    }

    /// The labels that occur besides 0, in words.
    pub(super) fn present(&self) -> String {
        let labels: Vec<String> = self
            .counts()
            .iter()
            .filter(|(label, _)| *label != 0)
            .map(|(label, _)| label.to_string())
            .collect();
        match labels.len() {
            0 => "nothing but 0".into(),
            n if n > NAMED_MAX => format!(
                "{n} labels, {} ... {}",
                labels[..3].join(", "),
                labels[n - 1]
            ),
            _ => labels.join(", "),
        }
    }

    fn refuse_unlikely_size(&self, path: &Path) -> Result<(), InputError> {
        let spacing = self.to_world.spacing_m();
        let sides: [f64; 3] = std::array::from_fn(|a| spacing[a] * self.size[a] as f64);
        let longest = sides.into_iter().fold(0.0, f64::max);
        let [low, high] = EXTENT_RANGE_M;
        let guess = if longest < low {
            "metres written where millimetres were meant"
        } else if longest > high {
            "millimetres under a header that says metres"
        } else {
            return Ok(());
        };
        let [x, y, z] = sides.map(|s| s * 1e3);
        let what = format!(
            "the volume is {x:.3} x {y:.3} x {z:.3} mm: that looks like {guess}; correct the voxel size or its unit"
        );
        Err(InputError::of(path, what))
    }
}

#[cfg(feature = "dicom")]
fn read_dicom(path: &Path) -> Result<LabelVolume, InputError> {
    super::dicom::read(path)
}

#[cfg(not(feature = "dicom"))]
fn read_dicom(path: &Path) -> Result<LabelVolume, InputError> {
    Err(InputError::new(format_args!(
        "{} is a folder or a DICOM file: this program was built without the DICOM reader; build it with \
         --features dicom, or convert the series to NIfTI or NRRD",
        path.display()
    )))
}

/// The size as `usize`, or an error when it exceeds the limit or is empty.
pub(super) fn checked_size(path: &Path, size: [u64; 3]) -> Result<[usize; 3], InputError> {
    if size.contains(&0) {
        return Err(not_one_volume(
            path,
            format!(
                "empty image of {} x {} x {} voxels",
                size[0], size[1], size[2]
            ),
        ));
    }
    let voxels = size.iter().try_fold(1_u64, |n, s| n.checked_mul(*s));
    if voxels.is_none_or(|v| v > VOXELS_MAX) {
        let [x, y, z] = size;
        let what = format!(
            "{x} x {y} x {z} voxels, the limit is {VOXELS_MAX} in all; crop or resample the volume"
        );
        return Err(InputError::of(path, what));
    }
    Ok(size.map(|s| s as usize))
}

/// Opens a file; a folder is rejected here, because a read error would be less specific.
pub(super) fn open(path: &Path) -> Result<(File, u64), InputError> {
    let file = File::open(path).map_err(InputError::io(path))?;
    let metadata = file.metadata().map_err(InputError::io(path))?;
    if metadata.is_dir() {
        return Err(not_labels(path, "this is a folder"));
    }
    if !metadata.is_file() {
        return Err(not_labels(path, "this is a device or a pipe; give a file"));
    }
    Ok((file, metadata.len()))
}

/// The warning about bytes after the last voxel.
pub(super) fn surplus(path: &Path, bytes: u64) -> String {
    format!(
        "{} has {bytes} bytes behind the last voxel of those that its header declares; they were \
         not read: check its size",
        path.display()
    )
}

/// Reads to the end of a compressed stream, within a limit, so that its checksum is verified.
pub(super) fn drain(from: &mut impl Read) -> std::io::Result<()> {
    /// Bytes after the last voxel that are read. Reason: programs append some padding, not more.
    const TAIL_MAX: u64 = 1 << 20;
    std::io::copy(&mut from.take(TAIL_MAX), &mut std::io::sink()).map(drop)
}

/// A file of no known format.
pub(super) fn not_labels(path: &Path, what: impl Display) -> InputError {
    let give =
        "give a NIfTI-1 (.nii, .nii.gz), an NRRD (.nrrd, .nhdr) or a folder with one DICOM series";
    InputError::of(path, format_args!("{what}; {give}"))
}

/// Invalid content at a field, line or voxel.
pub(super) fn broken(path: &Path, place: impl Display, what: impl Display) -> InputError {
    InputError::of(
        path,
        format_args!("{place}: {what}; export the volume again"),
    )
}

/// An image that is not a single volume.
pub(super) fn not_one_volume(path: &Path, what: impl Display) -> InputError {
    InputError::of(
        path,
        format_args!("{what}; export one label volume with three axes"),
    )
}

/// Samples of a type that can not hold labels.
pub(super) fn not_whole(path: &Path, what: impl Display) -> InputError {
    let labels = "labels are whole numbers from 0 to 65535 (any integer type, or floating point with whole values)";
    let what = format_args!("voxels are {what}; {labels}; export the segmentation, not the image");
    InputError::of(path, what)
}

/// A transform to the world, from these fields of the header, that is not usable.
pub(super) fn bad_orientation(path: &Path, from: impl Display, what: impl Display) -> InputError {
    let remedy = "save the volume again with a proper orientation";
    let what = format_args!("the orientation in the {from} is not usable: {what}; {remedy}");
    InputError::of(path, what)
}

/// Fewer voxels than the header declares.
pub(super) fn truncated(path: &Path, expected: u64, found: u64) -> InputError {
    let what = format_args!(
        "the data end after {found} of {expected} voxels; the file is cut short or its header is wrong; copy or \
         export it again"
    );
    InputError::of(path, what)
}

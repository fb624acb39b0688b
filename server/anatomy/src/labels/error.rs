//! Errors of label volumes.

use std::path::PathBuf;

use thiserror::Error;

use super::{NET_VERTICES_MAX, VOXELS_MAX};

/// The reason why a label volume was rejected.
#[derive(Debug, Error)]
pub enum LabelError {
    /// The file could not be opened or read.
    #[error("{}: {source}; check the path and that the file is readable", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Not one of the formats.
    #[error(
        "{}: {what}; give a NIfTI-1 (.nii, .nii.gz), an NRRD (.nrrd, .nhdr) or a folder with one \
         DICOM series",
        path.display()
    )]
    NotALabelVolume {
        /// The file.
        path: PathBuf,
        /// Description of the file.
        what: String,
    },
    /// The format is right but the content is invalid.
    #[error("{}: {place}: {what}; export the volume again", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// Field, line or voxel.
        place: String,
        /// The defect.
        what: String,
    },
    /// Fewer samples than the header promises.
    #[error(
        "{}: the data end after {found} of {expected} voxels; the file is cut short or its header \
         is wrong; copy or export it again",
        path.display()
    )]
    Truncated {
        /// The file with the samples.
        path: PathBuf,
        /// Voxels that the header promises.
        expected: u64,
        /// Voxels that were there.
        found: u64,
    },
    /// Samples that cannot be labels.
    #[error(
        "{}: voxels are {what}; labels are whole numbers from 0 to 65535 (any integer type, or \
         floating point with whole values); export the segmentation, not the image",
        path.display()
    )]
    SampleType {
        /// The file.
        path: PathBuf,
        /// The type in words.
        what: String,
    },
    /// A sample that is not a label.
    #[error(
        "{}: voxel ({}, {}, {}) holds {value}, which is no label; labels are whole numbers from 0 \
         to 65535; export the segmentation, not the image",
        path.display(), voxel[0], voxel[1], voxel[2]
    )]
    Value {
        /// The file.
        path: PathBuf,
        /// Index of the voxel.
        voxel: [usize; 3],
        /// Its value.
        value: f64,
    },
    /// Not one three-dimensional image.
    #[error("{}: {what}; export one label volume with three axes", path.display())]
    Dimensions {
        /// The file.
        path: PathBuf,
        /// Description of the content.
        what: String,
    },
    /// The transform from voxels to the world is unusable.
    #[error(
        "{}: the orientation in the {from} is not usable: {what}; save the volume again with a \
         proper orientation",
        path.display()
    )]
    Orientation {
        /// The file.
        path: PathBuf,
        /// The fields it was read from.
        from: String,
        /// The defect.
        what: String,
    },
    /// A size that no body has.
    #[error(
        "{}: the volume is {extent}: that looks like {guess}; correct the voxel size or its unit",
        path.display()
    )]
    UnlikelySize {
        /// The file.
        path: PathBuf,
        /// Its size in words.
        extent: String,
        /// The likely cause.
        guess: &'static str,
    },
    /// More voxels than the limit.
    #[error(
        "{}: {} x {} x {} voxels, the limit is {VOXELS_MAX} in all; crop or resample the volume",
        path.display(), size[0], size[1], size[2]
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Voxels along each axis.
        size: [u64; 3],
    },
    /// More boundary corners than the limit.
    #[error(
        "{}: the regions meet at {corners} corners of voxels, the limit is {NET_VERTICES_MAX}; crop \
         or resample the volume (is it a segmentation, and not noise?)",
        path.display()
    )]
    TooRough {
        /// The file.
        path: PathBuf,
        /// Number of corners where voxels of different regions meet.
        corners: usize,
    },
    /// A label that no voxel has.
    #[error("{}: label {label} does not occur; the volume holds {present}", path.display())]
    NoSuchLabel {
        /// The file.
        path: PathBuf,
        /// The label asked for.
        label: u16,
        /// The labels that do occur, in words.
        present: String,
    },
    /// All labels of a region belong to later regions too.
    #[error(
        "{}: later regions take every voxel of label {labels}, none is left; give each region a \
         label of its own",
        path.display()
    )]
    NothingLeft {
        /// The file.
        path: PathBuf,
        /// Its labels, in words.
        labels: String,
    },
    /// A DICOM series, while the program was built without the reader.
    #[error(
        "{} is a folder or a DICOM file: this program was built without the DICOM reader; build it \
         with --features dicom, or convert the series to NIfTI or NRRD",
        path.display()
    )]
    WithoutDicom {
        /// The folder or file.
        path: PathBuf,
    },
}

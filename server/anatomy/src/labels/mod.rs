//! Label volumes: images in which every voxel holds the number of the tissue it belongs to.
//!
//! [`LabelVolume::read`] brings NIfTI-1, NRRD and (with the feature `dicom`) DICOM files into one
//! form; [`surfaces`] extracts a closed surface per region from it, without gaps or overlaps
//! between neighbours.
//!
//! # World coordinates
//!
//! There is one world: x grows to the patient's right, y to the front, z upwards (RAS, as in NIfTI), in metres.
//! NRRD files in LPS or LAS and DICOM files, which are always LPS, are converted. Surfaces declare no
//! coordinate system and are not converted. A program that writes LPS (3D Slicer's default) must export
//! surfaces as RAS to match the label volume of the same subject.
//!
//! The readers are our own. NIfTI and NRRD differ in a page of header code and share the reading of samples,
//! whose memory is bounded by the checked header regardless of the file's content.

mod affine;
#[cfg(feature = "dicom")]
mod dicom;
mod extract;
mod nifti;
mod nrrd;
mod samples;
mod volume;
mod voxel_runs;

pub use affine::Affine;
pub use extract::{LabelRegion, NET_VERTICES_MAX, RegionSurface, Sides, surfaces, voxel_runs};
pub use volume::LabelVolume;
pub use voxel_runs::{VoxelRun, VoxelRuns};

/// Most voxels of one volume. Reason: a whole body at 0.7 mm in the slice and 2 mm along has about 250 million;
/// as labels they take half a gigabyte. Beyond the bound the volume is rejected unread.
pub const VOXELS_MAX: u64 = 1 << 28;

/// Smallest and largest length in m of the longest side of a volume. Reason: nothing can be felt in a body
/// below 5 mm, and none is longer than 5 m; both result from a confusion of metres and millimetres. Outside the
/// range the volume is rejected, and the message names the likely cause.
pub const EXTENT_RANGE_M: [f64; 2] = [5e-3, 5.0];

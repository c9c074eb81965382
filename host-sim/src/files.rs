//! The files of a run: image, record, checkpoint, frames.

use firmware::image::{Image, Port, layout};
use model_compiler::artifact;
use model_compiler::cli::ResizeArgs;
use model_compiler::emit::AlignedBytes;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::{self, Frame, FrameFormat};
use model_compiler::import::ImportOptions;
use model_compiler::ir::{Graph, InputKind};
use model_compiler::passes::PassOptions;
use model_compiler::pipeline;
use model_compiler::record::Record;
use std::io::Read;
use std::path::{Path, PathBuf};

/// A model image in memory, aligned as in flash.
#[derive(Debug)]
pub struct ImageFile {
    path: PathBuf,
    bytes: AlignedBytes,
}

impl ImageFile {
    /// Reads an image file.
    ///
    /// # Errors
    /// The file cannot be read or is no image.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = read_aligned(path).map_err(|e| Error::io(path, &e))?;
        if !is_image(&bytes) {
            let error = Error::new(ErrorCode::Malformed, path.display().to_string(), "this is no model image");
            return Err(error.with_help("model-compiler compile makes one: compile MODEL --calib FRAMES -o OUT.img"));
        }
        Ok(Self { path: path.to_path_buf(), bytes })
    }

    /// The image behind the bytes.
    ///
    /// # Errors
    /// The runtime's own checks refuse it, those over all bytes included.
    pub fn parse(&self) -> Result<Image<'_>> {
        let refuse = |error: Error| error.within(self.path.display());
        let image = Image::parse(&self.bytes).map_err(|e| refuse(e.into()))?;
        image.check().map_err(|e| refuse(e.into()))?;
        Ok(image)
    }

    /// SHA-256 of the file.
    pub fn sha256(&self) -> [u8; 32] {
        artifact::sha256(&self.bytes)
    }

    /// Size of the file: bytes of flash.
    pub fn flash_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }

    /// Reads the record that belongs to the image: the given file, or the one beside the image.
    ///
    /// # Errors
    /// The record is missing or damaged, or belongs to another image.
    pub fn record(&self, path: Option<&Path>) -> Result<Record> {
        let path = path.map_or_else(|| pipeline::record_path(&self.path), Path::to_path_buf);
        let record: Record = artifact::read(&path).map_err(|e| match e.code {
            ErrorCode::Io => e.with_help("the record is written beside the image; --record FILE names another place"),
            _ => e,
        })?;
        if record.image_sha256 != self.sha256() {
            let found = artifact::hex(&self.sha256()[..8]);
            let expected = artifact::hex(&record.image_sha256[..8]);
            let message = format!(
                "the record belongs to another image: digest of {} is {found}…, expected {expected}…",
                self.path.display()
            );
            let error = Error::new(ErrorCode::Malformed, path.display().to_string(), message);
            return Err(error.with_help("compile again, or keep OUT.img and OUT.record of one build together"));
        }
        Ok(record)
    }
}

/// Whether a file is a model image, by its first bytes.
///
/// # Errors
/// The file cannot be read.
pub fn is_image_file(path: &Path) -> Result<bool> {
    let mut start = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| Error::io(path, &e))?;
    file.take(layout::MAGIC.len() as u64).read_to_end(&mut start).map_err(|e| Error::io(path, &e))?;
    Ok(is_image(&start))
}

fn is_image(bytes: &[u8]) -> bool {
    bytes.starts_with(&layout::MAGIC)
}

/// SHA-256 of a file, as 64 hexadecimal digits.
///
/// # Errors
/// The file cannot be read.
pub fn file_sha256(path: &Path) -> Result<String> {
    Ok(artifact::hex(&artifact::sha256(&read(path)?)))
}

/// The optimized float graph of a checkpoint.
///
/// # Errors
/// The file is no checkpoint of a known system.
pub fn load_graph(path: &Path, import: &ImportOptions) -> Result<Graph> {
    pipeline::load_graph(path, import, &PassOptions::default())
}

/// Where frames come from.
#[derive(Clone, Debug, Default, PartialEq, Eq, clap::Args)]
#[group(skip)]
pub struct FrameSource {
    /// Frame directory: a folder per frame with rgb.png, lidar.bin and frame.json (lbc: rgb.png, rgb_left.png,
    /// rgb_right.png and frame.json); for classifiers: a folder of images, optionally with labels.csv (lines FILE,LABEL
    /// or FILE,LABEL,NAME).
    #[arg(long, value_name = "DIR", required_unless_present = "inputs", conflicts_with = "inputs")]
    pub frames: Option<PathBuf>,
    /// Raw network inputs by name, first dimension = frames; of a classifier also `label`.
    #[arg(long, value_name = "FILE.safetensors")]
    pub inputs: Option<PathBuf>,
    /// Which of them, and how they are read.
    #[command(flatten)]
    pub selection: FrameSelection,
}

/// Which frames of a source, and how they are read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::Args)]
pub struct FrameSelection {
    /// Only the first N frames.
    #[arg(long, value_name = "N", value_parser = limit)]
    pub frames_limit: Option<usize>,
    /// Images of another size.
    #[command(flatten)]
    pub resize: ResizeArgs,
}

fn limit(text: &str) -> std::result::Result<usize, String> {
    text.parse().ok().filter(|&n| n > 0).ok_or_else(|| format!("found {text:?}, expected a number of frames from 1"))
}

impl FrameSource {
    /// Loads what the network reads.
    ///
    /// # Errors
    /// See [`frames::load`]; also a file where a directory is expected and the other way round.
    pub fn load(&self, format: &FrameFormat) -> Result<Vec<Frame>> {
        let format = FrameFormat { resize: self.selection.resize.resize, ..format.clone() };
        let mut frames = self.load_all(&format)?;
        frames.truncate(self.selection.frames_limit.unwrap_or(usize::MAX));
        Ok(frames)
    }

    fn load_all(&self, format: &FrameFormat) -> Result<Vec<Frame>> {
        let usage = |path: &Path, message: &str| Err(Error::new(ErrorCode::Usage, path.display().to_string(), message));
        match (&self.frames, &self.inputs) {
            (Some(path), _) if path.is_file() => usage(path, "--frames takes a directory; a file goes to --inputs"),
            (None, Some(path)) if path.is_dir() => usage(path, "--inputs takes a file; a directory goes to --frames"),
            (Some(path), _) | (None, Some(path)) => frames::load(path, format),
            (None, None) => {
                Err(Error::new(ErrorCode::Usage, "", "no frames given").with_help("--frames DIR or --inputs FILE"))
            }
        }
    }
}

/// What an image reads, from its ports alone.
///
/// # Errors
/// An input has a name that no sensor fills.
pub fn frame_format(image: &Image<'_>) -> Result<FrameFormat> {
    let ports = (0..image.input_count()).filter_map(|i| image.input(i));
    let shape = |id| image.tensor(id).map(|record| record.shape);
    let inputs = ports.filter_map(|port| Some((port, shape(port.tensor)?)));
    let inputs = inputs.map(|(port, shape)| Ok((input_kind(&port)?, shape))).collect::<Result<Vec<_>>>()?;
    // The height that splits the histogram is not in the image; of the systems with a histogram only TransFuser
    // reads the speed, and only Geometric Fusion cells to gather.
    let reads = |wanted| inputs.iter().any(|(kind, _)| *kind == wanted);
    let system = match (reads(InputKind::Velocity), reads(InputKind::BevPoints)) {
        (true, _) => "transfuser",
        (false, true) => "geometric_fusion",
        (false, false) => "late_fusion",
    };
    let format = FrameFormat::new(system, inputs);
    let name = image.input(0).map_or("", |port| port.name);
    Ok(format.with_output(name, image.output(0).and_then(|port| shape(port.tensor))))
}

/// What an input holds: by its name, or, since classifiers name theirs as they like, an image by its codes (one per
/// grey level, zero point −128).
///
/// # Errors
/// The name is unknown, and it is no image.
pub fn input_kind(port: &Port<'_>) -> Result<InputKind> {
    let named = InputKind::ALL.into_iter().find(|kind| kind.name() == port.name);
    let is_image = port.scale == 1.0 && port.zero_point == -128;
    named.or(is_image.then_some(InputKind::Image)).ok_or_else(|| {
        Error::new(ErrorCode::Unsupported, format!("input `{}`", port.name), "no sensor gives this input")
    })
}

/// A file, without a second copy on the way; what has no length of its own (a pipe) is read to its end first.
fn read_aligned(path: &Path) -> std::io::Result<AlignedBytes> {
    let mut file = std::fs::File::open(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        return Ok(AlignedBytes::from(bytes.as_slice()));
    }
    let mut bytes = AlignedBytes::zeroed(metadata.len() as usize);
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

fn read(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(|e| Error::io(path, &e))
}

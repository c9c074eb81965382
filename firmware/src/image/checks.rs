//! Every single check of [`super::Image::parse`], numbered, with the words that explain a failure.

use super::SectionKind;
use core::fmt;

/// Declares [`Check`], its list and its words in one table, so that none can be forgotten.
macro_rules! checks {
    ($($name:ident: $words:literal,)*) => {
        /// One check of `parse`. The number is stable within a release only.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        #[repr(u16)]
        pub enum Check {
            $(#[doc = $words] $name,)*
        }

        impl Check {
            /// All checks in order of their numbers.
            pub const ALL: &'static [Self] = &[$(Self::$name),*];

            /// 1, 2, …; what `fault::disable_check` takes.
            pub const fn number(self) -> u16 {
                (self as u16).saturating_add(1)
            }

            /// What a failure means, in plain words.
            pub const fn words(self) -> &'static str {
                match self {
                    $(Self::$name => $words,)*
                }
            }
        }
    };
}

checks! {
    Misaligned: "the image must lie at an address that is a multiple of 16",
    HeaderLength: "the file is shorter than a header",
    Magic: "this is not a model image",
    Format: "the format version is not the one this runtime reads",
    HeaderCrc: "the header is damaged (CRC)",
    TotalBytes: "the file length differs from the header's",
    HeaderReserved: "reserved header bytes must be zero",
    Features: "the image needs features that this runtime does not have",
    StepCount: "the number of steps is out of range",
    TensorCount: "the number of tensors is out of range",
    InputCount: "the number of inputs is out of range",
    OutputCount: "the number of outputs is out of range",
    RegionCount: "the number of memory regions must be 1 to 4",
    RegionName: "the name of a memory region is not visible ASCII, zero-padded",
    RegionRepeated: "two memory regions have the same name",
    RegionAlignment: "the alignment of a memory region must be a power of two from 16 to 4096",
    RegionBytes: "the memory regions together must have less than 4 GiB",
    ModelName: "the model name is not zero-padded UTF-8",
    TargetName: "the target name is not zero-padded visible ASCII",
    SectionKind: "a section is not where this format has it",
    SectionOffset: "sections must follow each other without gaps",
    SectionLength: "the section has a wrong length",
    SectionEnd: "the sections do not fill the file",
    SectionPadding: "padding must be zero",
    SectionCrc: "the section is damaged (CRC)",
    TensorElement: "unknown element type",
    TensorReserved: "reserved bytes of a tensor record must be zero",
    TensorRegion: "the tensor lies in a memory region that the header does not list",
    TensorBatch: "the batch size must be 1 (0 for scratch)",
    TensorShape: "a tensor must not be empty, scratch has no shape",
    TensorBytes: "the length differs from what shape and type imply",
    TensorAlignment: "the offset must be a multiple of 4",
    TensorInside: "the tensor ends outside its memory region",
    TensorLive: "the live range is reversed or ends behind the program",
    TensorWritten: "no step (or not the one recorded) writes this tensor",
    TensorLastUse: "the recorded last step does not read this tensor",
    TensorOutputLive: "a network output must stay live to the last step",
    TensorInPlace: "inputs and scratch cannot take over memory",
    ScratchOneStep: "scratch belongs to exactly one step",
    PortText: "the name of an input or output is not zero-padded UTF-8",
    PortScale: "the scale must be positive and finite",
    PortZeroPoint: "the zero point is outside the element type",
    PortTensor: "an input or output names no tensor of the table",
    PortRepeated: "the same tensor is listed twice",
    InputFirstStep: "an input must be live from step 0",
    InputOverlap: "two inputs share memory",
    StepIndex: "the step index must rise from 0 inside the program",
    StepDecode: "the bytes are no step of this format",
    StepLength: "a step must fill its bytes exactly",
    StepFeatures: "the feature bits differ from what the program uses",
    StepTensor: "the step names no tensor of the table",
    StepReadsScratch: "the step reads or writes scratch as a tensor",
    StepReadLive: "the step reads a tensor that holds nothing at that time",
    StepWritesInput: "the step writes an input",
    StepWritesOnce: "the step writes a tensor that another step writes",
    StepOverlap: "the step writes memory that holds another live tensor",
    StepScratch: "the working memory is not scratch of this step",
    StepScratchBytes: "the working memory is missing or too small",
    InPlaceOperand: "the operator cannot take over this operand's memory",
    InPlaceOnce: "an operand that is overwritten must occur once",
    InPlacePosition: "the overwritten operand lies elsewhere or has another type or size",
    InPlaceLastUse: "the overwritten operand is used later",
    InPlaceOrder: "the pool would overwrite values that it still needs",
    ConstAligned: "the constant range must be a multiple of 16",
    ConstInside: "the constant range ends outside its section",
    ConstLength: "the constant range has another length than the shapes imply",
    StepElement: "an operand has an element type that the operator does not take",
    StepShape: "the shapes of the operands do not fit together",
    StepWindow: "the window does not fit the shapes",
    StepDilation: "a pool has dilation 1",
    StepPadding: "padding must be smaller than the kernel (0 for an average pool)",
    StepGroups: "the groups do not divide the channels",
    StepZeroPoint: "a zero point is outside its element type (0 for 16 bit)",
    StepClamp: "the output bounds are reversed or outside the element type",
    StepPreShift: "the shift of the accumulator is out of range",
    StepShift: "a shift is out of range",
    StepMultiplier: "a multiplier is out of range",
    StepWeightBits: "the interpolation weights must have 4 to 11 bits",
    StepFactor: "the enlargement must be by a whole factor",
    StepTokenPool: "the token grid does not divide the map",
    StepEpsilon: "epsilon is out of range",
    StepRows: "the rows lie outside the input",
    StepChannels: "more channels than the operator can sum exactly",
    StepTokens: "more tokens than attention can sum exactly",
    StepHeads: "the heads do not divide the channels, or one is too wide",
    StepFraction: "the fraction bits of the hidden state are out of range",
    StepBox: "the box leaves the input or the output",
    StepBorder: "the code of the border is outside the element type",
    StepBranches: "the number of branches is out of range",
    StepResidual: "the operator has no second term",
    StepPixels: "more rows or columns than the operator can sum exactly",
    Work: "the program would run too long",
}

/// Where in the image something is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Place {
    /// The file as a whole.
    File,
    /// The header field at this byte.
    Header(u16),
    /// A section.
    Section(SectionKind),
    /// A record of the tensor table.
    Tensor(u16),
    /// An input, by index.
    Input(u8),
    /// An output, by index.
    Output(u8),
    /// A step, by position.
    Step(u16),
    /// A step and one of its tensors.
    StepTensor(u16, u16),
    /// A step and the first byte of one of its constants.
    StepConstant(u16, u32),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => write!(f, "image"),
            Self::Header(byte) => write!(f, "header byte {byte}"),
            Self::Section(kind) => write!(f, "{} section", kind.name()),
            Self::Tensor(id) => write!(f, "tensor {id}"),
            Self::Input(index) => write!(f, "input {index}"),
            Self::Output(index) => write!(f, "output {index}"),
            Self::Step(position) => write!(f, "step {position}"),
            Self::StepTensor(position, id) => write!(f, "step {position}, tensor {id}"),
            Self::StepConstant(position, byte) => write!(f, "step {position}, constants at byte {byte}"),
        }
    }
}

/// Why an image is refused: the first check that failed, where, and the two values that disagree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ParseError {
    /// The check that failed.
    pub check: Check,
    /// Where.
    pub place: Place,
    /// What the image holds (an address modulo 16, a count, a code, a CRC, …).
    pub found: i64,
    /// What was expected: the value, or the nearest allowed bound.
    pub expected: i64,
}

impl fmt::Display for ParseError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { check, place, found, expected } = self;
        write!(f, "{place}: {}: found {found}, expected {expected}", check.words())
    }
}

impl core::error::Error for ParseError {}

/// The one door of all checks: an error unless `holds`. Tests can close it for one check at a time.
#[inline]
pub(crate) fn ensure(
    check: Check,
    place: Place,
    holds: bool,
    found: impl Into<i64>,
    expected: impl Into<i64>,
) -> Result<(), ParseError> {
    if holds || crate::fault::check_disabled(check.number()) {
        return Ok(());
    }
    Err(ParseError { check, place, found: found.into(), expected: expected.into() })
}

/// [`ensure`] for two values that must be equal.
#[inline]
pub(crate) fn ensure_equal<T: Into<i64> + PartialEq>(
    check: Check,
    place: Place,
    found: T,
    expected: T,
) -> Result<(), ParseError> {
    let holds = found == expected;
    ensure(check, place, holds, found, expected)
}

/// A `u64` in an error message.
pub(crate) fn shown(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

//! Small programs drawn by hand, and images made from them that one single check of the parser refuses.

use firmware::image::layout::{header, region, tensor};
use firmware::image::{Check, Region, RegionName, SectionKind, TensorRecord, layout};
use firmware::program::{
    Add, Attention, AveragePool, BranchLinear, Clamp, ConstRange, Conv2d, CopyBox, KernelId, LayerNorm, Linear,
    MaxPool, Requant, Requantize, Rescale, Residual, ResizeBilinear, SpatialSoftmax, Step, Term, TokenSource, Tokens,
    Window,
};
use firmware::tensor::{ElementType, Shape, TensorId};
use model_compiler::emit::{ImageParts, ImagePort, assemble, reseal};

const FULL: Clamp = Clamp { min: -128, max: 127 };
const HALF: Requant = Requant { multiplier: 1 << 23, shift: 24 };

/// A program whose tensors all have memory of their own.
#[derive(Clone, Debug, Default)]
pub struct Sketch {
    tensors: Vec<(ElementType, Shape)>,
    scratch: Vec<(TensorId, u32)>,
    steps: Vec<Step>,
    inputs: Vec<TensorId>,
    outputs: Vec<TensorId>,
    constants: u32,
}

impl Sketch {
    fn tensor(&mut self, element: ElementType, shape: Shape) -> TensorId {
        self.tensors.push((element, shape));
        TensorId(self.tensors.len() as u16 - 1)
    }

    fn input(&mut self, shape: Shape) -> TensorId {
        let id = self.tensor(ElementType::I8, shape);
        self.inputs.push(id);
        id
    }

    fn scratch(&mut self, bytes: u32) -> Option<TensorId> {
        let id = self.tensor(ElementType::Scratch, Shape { height: 0, width: 0, channels: 0 });
        self.scratch.push((id, bytes));
        Some(id)
    }

    fn constant(&mut self, bytes: u32) -> ConstRange {
        let range = ConstRange { offset: self.constants, bytes };
        self.constants = (self.constants + bytes).next_multiple_of(16);
        range
    }

    fn shape(&self, id: TensorId) -> Shape {
        self.tensors[usize::from(id.0)].1
    }

    fn requantize_to(&mut self, input: TensorId, output: TensorId) {
        self.steps.push(Step::Requantize(Requantize {
            input,
            output,
            input_zero_point: 0,
            requant: HALF,
            zero_point: 0,
            clamp: FULL,
        }));
    }

    fn requantize(&mut self, input: TensorId) -> TensorId {
        let output = self.tensor(ElementType::I8, self.shape(input));
        self.requantize_to(input, output);
        output
    }

    fn add(&mut self, first: TensorId, second: TensorId) -> TensorId {
        let output = self.tensor(ElementType::I8, self.shape(first));
        let term = |tensor| Term { tensor, zero_point: 0, multiplier: 1 };
        let (first, second) = (term(first), term(second));
        self.steps.push(Step::Add(Add { first, second, output, shift: 1, zero_point: 0, clamp: FULL }));
        output
    }

    fn rescale(&mut self, channels: u16) -> Rescale {
        let words = u32::from(channels) * 4;
        Rescale {
            pre_shift: 0,
            bias: self.constant(words),
            multipliers: self.constant(words),
            shifts: self.constant(channels.into()),
            zero_point: 0,
            clamp: FULL,
            residual: Residual::None,
        }
    }

    fn linear(&mut self, input: TensorId) -> TensorId {
        let shape = self.shape(input);
        let output = self.tensor(ElementType::I8, shape);
        let weights = self.constant(u32::from(shape.channels) * u32::from(shape.channels));
        let rescale = self.rescale(shape.channels);
        let scratch = self.scratch(8 * u32::from(shape.channels));
        let kernel = KernelId::Direct;
        self.steps.push(Step::Linear(Linear { input, output, kernel, weights, wide: false, rescale, scratch }));
        output
    }

    fn conv(&mut self, input: TensorId, window: Window, groups: u16, depth: u16, output: Shape) -> TensorId {
        let output_id = self.tensor(ElementType::I8, output);
        let taps = u32::from(window.kernel_h) * u32::from(window.kernel_w) * u32::from(depth);
        let weights = self.constant(taps * u32::from(output.channels));
        let padding_codes = self.constant(self.shape(input).channels.into());
        let rescale = self.rescale(output.channels);
        let (kernel, scratch) = (KernelId::Direct, self.scratch(8 * taps));
        let output = output_id;
        self.steps.push(Step::Conv2d(Conv2d {
            input,
            output,
            window,
            groups,
            kernel,
            weights,
            padding_codes,
            rescale,
            scratch,
        }));
        output
    }

    fn max_pool(&mut self, input: TensorId, window: Window, output: Shape) -> TensorId {
        let output = self.tensor(ElementType::I8, output);
        self.steps.push(Step::MaxPool(MaxPool { input, output, window }));
        output
    }

    /// Tables with true live ranges; what nobody reads is an output.
    pub fn parts(&self) -> ImageParts {
        let last = self.steps.len().saturating_sub(1) as u16;
        let mut offset = 0;
        let mut tensors: Vec<TensorRecord> = Vec::new();
        for (number, (element, shape)) in self.tensors.iter().enumerate() {
            let id = TensorId(number as u16);
            let writes = |step: &Step| step.output() == id || step.scratch() == Some(id);
            let first = self.steps.iter().position(writes).filter(|_| !self.inputs.contains(&id)).unwrap_or(0) as u16;
            let read = self.steps.iter().rposition(|step| step.reads().contains(&Some(id)));
            let last_step = if self.outputs.contains(&id) { last } else { read.map_or(first, |step| step as u16) };
            let scratch = self.scratch.iter().find(|(scratch, _)| *scratch == id);
            let bytes = scratch.map_or(shape.elements() as u32 * element.bytes(), |(_, bytes)| *bytes);
            tensors.push(TensorRecord {
                element: *element,
                shape: *shape,
                region: 0,
                offset,
                bytes,
                first_step: first,
                last_step,
                in_place_of: None,
            });
            offset = (offset + bytes.max(1)).next_multiple_of(16);
        }
        let port = |id: &TensorId| ImagePort { name: format!("t{}", id.0), tensor: *id, scale: 1.0, zero_point: 0 };
        ImageParts {
            name: "sketch".into(),
            tensors,
            steps: self.steps.clone(),
            constants: vec![1; self.constants as usize],
            inputs: self.inputs.iter().map(port).collect(),
            outputs: self.outputs.iter().map(port).collect(),
            regions: vec![Region { name: RegionName::MAIN, bytes: offset, alignment: 16 }],
            qmodel_digest: [0; 32],
            build_digest: [0; 32],
            target: String::new(),
            revision: 0,
            known_answer: None,
        }
    }

    fn finish(mut self, output: TensorId) -> ImageParts {
        self.outputs.push(output);
        self.parts()
    }
}

/// One input, a chain of steps, the end as output.
fn chain(steps: usize, step: fn(&mut Sketch, TensorId) -> TensorId) -> ImageParts {
    let mut sketch = Sketch::default();
    let mut x = sketch.input(Shape::vector(4));
    for _ in 0..steps {
        x = step(&mut sketch, x);
    }
    sketch.finish(x)
}

fn window(kernel: u8, stride: u8) -> Window {
    Window::square(kernel, stride, 0)
}

fn sealed(parts: &ImageParts) -> Vec<u8> {
    assemble(parts).unwrap_or_else(|e| panic!("{e}"))
}

/// An image edited after it was assembled.
fn edited(parts: &ImageParts, edit: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
    let mut bytes = sealed(parts);
    edit(&mut bytes);
    reseal(&mut bytes);
    bytes
}

/// One image per check that single-field mutations do not isolate: this check refuses it and no other.
///
/// # Panics
/// Never: all parts fit their fields.
pub fn refused_by_one_check() -> Vec<(Check, Vec<u8>)> {
    let mut all = of_the_file();
    all.extend(of_the_tables());
    all.extend(of_in_place_pairs());
    all.extend(of_operators());
    all
}

fn of_the_file() -> Vec<(Check, Vec<u8>)> {
    let small = chain(3, Sketch::requantize);
    let section = |kind: SectionKind, field: std::ops::Range<usize>| {
        let start = header::SECTIONS.start + kind as usize * layout::section::BYTES;
        start + field.start..start + field.end
    };
    let mut ports = Sketch::default();
    let inputs: Vec<TensorId> = (0..17).map(|_| ports.input(Shape::vector(1))).collect();
    let many_inputs = {
        let mut sketch = ports.clone();
        let output = sketch.requantize(inputs[0]);
        sketch.finish(output)
    };
    let mut sketch = Sketch::default();
    let x = sketch.input(Shape::vector(1));
    sketch.outputs = (0..17).map(|_| sketch.requantize(x)).collect();
    let many_outputs = sketch.parts();
    let longer = edited(&small, |bytes| {
        bytes.extend([0; 16]);
        let total = (bytes.len() as u32).to_le_bytes();
        bytes[header::TOTAL_BYTES].copy_from_slice(&total);
    });
    let mut header_crc = sealed(&small);
    header_crc[header::CRC.start] ^= 1;
    let mut section_crc = sealed(&small);
    section_crc[section(SectionKind::Ports, layout::section::CRC).start] ^= 1;
    let crc = firmware::image::crc32(&section_crc[..header::CRC.start]);
    section_crc[header::CRC].copy_from_slice(&crc.to_le_bytes());
    let stray_padding = edited(&small, |bytes| {
        let program = section(SectionKind::Program, layout::section::OFFSET);
        let start = u32::from_le_bytes(bytes[program].try_into().expect("four bytes")) as usize;
        bytes[start - 1] = 1; // behind the three entries of the step index
    });
    let with_regions = |regions: &[(&str, u32)]| {
        let mut parts = small.clone();
        parts.regions.extend(regions.iter().map(|&(name, bytes)| Region {
            name: RegionName::new(name).expect("a name"),
            bytes,
            alignment: 16,
        }));
        parts
    };
    let four = with_regions(&[("a", 16), ("b", 16), ("c", 16)]);
    let mut answered = small.clone();
    answered.known_answer = Some(model_compiler::emit::KnownAnswer { seed: 1, step_crcs: vec![0; 4] });
    vec![
        (Check::HeaderCrc, header_crc),
        (Check::SectionCrc, section_crc),
        (Check::SectionPadding, stray_padding),
        (Check::StepCount, sealed(&chain(2049, Sketch::requantize))),
        (Check::TensorCount, sealed(&chain(2048, Sketch::linear))),
        (Check::InputCount, sealed(&many_inputs)),
        (Check::OutputCount, sealed(&many_outputs)),
        (Check::RegionCount, edited(&four, |bytes| bytes[header::REGION_COUNT].fill(5))),
        (Check::RegionRepeated, sealed(&with_regions(&[("main", 16)]))),
        (Check::RegionBytes, sealed(&with_regions(&[("fast", u32::MAX)]))),
        (Check::SectionLength, sealed(&answered)),
        (Check::SectionEnd, longer),
        (Check::StepIndex, program_edited(&small, |program| program.insert(0, 0), 1)),
        (Check::StepLength, program_edited(&small, |program| program.push(0), 0)),
        (Check::StepDecode, stray_step(&small)),
    ]
}

/// The image with other program bytes; every entry of the step index rises by `shift`.
fn program_edited(parts: &ImageParts, edit: impl Fn(&mut Vec<u8>), shift: u32) -> Vec<u8> {
    rebuilt(parts, |index, program| {
        edit(program);
        index.iter_mut().for_each(|start| *start += shift);
    })
}

/// One more step, of bytes that are no step; outputs stay live until then.
fn stray_step(parts: &ImageParts) -> Vec<u8> {
    let mut parts = parts.clone();
    for port in &parts.outputs {
        parts.tensors[usize::from(port.tensor.0)].last_step += 1;
    }
    rebuilt(&parts, |index, program| {
        index.push(program.len() as u32);
        program.push(0xFF);
    })
}

/// Takes the program section apart and puts the file together again.
fn rebuilt(parts: &ImageParts, edit: impl Fn(&mut Vec<u32>, &mut Vec<u8>)) -> Vec<u8> {
    let bytes = sealed(parts);
    let slot = |kind: SectionKind| header::SECTIONS.start + kind as usize * layout::section::BYTES;
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    let content = |kind: SectionKind| {
        let (offset, length) = (word(slot(kind) + 4) as usize, word(slot(kind) + 8) as usize);
        bytes[offset..offset + length].to_vec()
    };
    let mut sections = SectionKind::ALL.map(content);
    let index = &sections[SectionKind::StepIndex as usize];
    let mut index: Vec<u32> =
        index.chunks(4).map(|entry| u32::from_le_bytes(entry.try_into().expect("four bytes"))).collect();
    edit(&mut index, &mut sections[SectionKind::Program as usize]);
    sections[SectionKind::StepIndex as usize] = index.iter().flat_map(|start| start.to_le_bytes()).collect();
    let mut file = bytes[..header::BYTES].to_vec();
    file[header::STEP_COUNT].copy_from_slice(&(index.len() as u16).to_le_bytes());
    for (kind, content) in SectionKind::ALL.into_iter().zip(&sections) {
        let (offset, length) = (file.len() as u32, content.len() as u32);
        file[slot(kind) + 4..slot(kind) + 8].copy_from_slice(&offset.to_le_bytes());
        file[slot(kind) + 8..slot(kind) + 12].copy_from_slice(&length.to_le_bytes());
        file.extend(content);
        file.resize(file.len().next_multiple_of(layout::ALIGNMENT), 0);
    }
    let total = (file.len() as u32).to_le_bytes();
    file[header::TOTAL_BYTES].copy_from_slice(&total);
    reseal(&mut file);
    file
}

fn of_the_tables() -> Vec<(Check, Vec<u8>)> {
    let vector = Shape::vector(4);
    let mut sketch = Sketch::default();
    let x = sketch.input(vector);
    let spare = sketch.input(vector);
    let y = sketch.requantize(x);
    let z = sketch.add(y, x);
    let last = sketch.requantize(y);
    sketch.outputs.extend([z, last]);
    let base = sketch.parts();
    let with = |edit: &dyn Fn(&mut ImageParts)| {
        let mut parts = base.clone();
        edit(&mut parts);
        sealed(&parts)
    };
    let record = |id: TensorId| usize::from(id.0);
    let (y_record, spare_record) = (base.tensors[record(y)], record(spare));
    // A record that nobody names: its type is looked at nowhere else.
    let orphan = TensorRecord { last_step: 0, ..y_record };
    let mut stray = base.clone();
    stray.tensors.push(orphan);
    let first_record = header::BYTES + 32 * (base.inputs.len() + base.outputs.len());
    let stray = edited(&stray, |bytes| bytes[first_record + 32 * base.tensors.len() + tensor::ELEMENT.start] = 9);
    // The sum reads a tensor that no step writes.
    let mut unwritten = sketch.clone();
    let ghost = unwritten.tensor(ElementType::I8, vector);
    if let Step::Add(add) = &mut unwritten.steps[1] {
        add.second.tensor = ghost;
    }
    // Two steps write one tensor.
    let mut twice = Sketch::default();
    let a = twice.input(vector);
    let b = twice.requantize(a);
    twice.requantize_to(a, b);
    // The program's first step writes a network input.
    let mut writes_input = base.clone();
    writes_input.inputs.push(ImagePort { name: "y".into(), tensor: y, scale: 1.0, zero_point: 0 });
    vec![
        (Check::TensorElement, stray),
        (
            Check::TensorShape,
            with(&|parts| {
                parts.tensors[spare_record].shape.height = 0;
                parts.tensors[spare_record].bytes = 0;
            }),
        ),
        (Check::TensorWritten, sealed(&unwritten.parts())),
        (Check::TensorOutputLive, with(&|parts| parts.tensors[record(z)].last_step = 1)),
        (Check::PortTensor, output_read_last(|port, _| port.tensor = TensorId(99))),
        (Check::PortRepeated, output_read_last(|port, other| port.tensor = other)),
        (Check::InputOverlap, with(&|parts| parts.tensors[spare_record].offset = parts.tensors[record(x)].offset)),
        (Check::StepWritesInput, sealed(&writes_input)),
        (Check::StepWritesOnce, sealed(&twice.finish(b))),
        (Check::Features, edited(&base, |bytes| bytes[header::FEATURES.end - 1] = 0x80)),
        (
            Check::TensorInside,
            edited(&base, |bytes| {
                let arena = header::REGIONS.start + region::ARENA_BYTES.start;
                bytes[arena..arena + 4].copy_from_slice(&16_u32.to_le_bytes());
            }),
        ),
    ]
}

/// A network whose first output is also read by the last step, so that its live range stays true without its port.
fn output_read_last(edit: impl Fn(&mut ImagePort, TensorId)) -> Vec<u8> {
    let mut sketch = Sketch::default();
    let x = sketch.input(Shape::vector(4));
    let y = sketch.requantize(x);
    let z = sketch.requantize(y);
    sketch.outputs.extend([y, z]);
    let mut parts = sketch.parts();
    edit(&mut parts.outputs[0], z);
    sealed(&parts)
}

fn of_in_place_pairs() -> Vec<(Check, Vec<u8>)> {
    let vector = Shape::vector(4);
    let over = |parts: &mut ImageParts, output: TensorId, operand: TensorId| {
        let offset = parts.tensors[usize::from(operand.0)].offset;
        let record = &mut parts.tensors[usize::from(output.0)];
        (record.in_place_of, record.offset) = (Some(operand), offset);
    };
    let mut sketch = Sketch::default();
    let x = sketch.input(vector);
    let y = sketch.requantize(x);
    let mut operand = sketch.finish(y);
    over(&mut operand, y, x);
    let mut sketch = Sketch::default();
    let x = sketch.input(vector);
    let y = sketch.add(x, x);
    let mut once = sketch.finish(y);
    over(&mut once, y, x);
    let mut sketch = Sketch::default();
    let (x, other) = (sketch.input(vector), sketch.input(vector));
    let y = sketch.add(x, other);
    let z = sketch.add(x, y);
    let mut last_use = sketch.finish(z);
    over(&mut last_use, y, x);
    let mut position = last_use.clone();
    position.tensors[usize::from(y.0)].in_place_of = None;
    position.tensors[usize::from(y.0)].offset = position.regions[0].bytes - 4;
    position.regions[0].bytes += 16;
    position.tensors[usize::from(z.0)].in_place_of = Some(x);
    let mut sketch = Sketch::default();
    let map = Shape::map(4, 4, 1);
    let x = sketch.input(map);
    let same = Window { pad_top: 1, pad_bottom: 1, pad_left: 1, pad_right: 1, ..window(3, 1) };
    let y = sketch.max_pool(x, same, map);
    let mut order = sketch.finish(y);
    over(&mut order, y, x);
    vec![
        (Check::InPlaceOperand, sealed(&operand)),
        (Check::InPlaceOnce, sealed(&once)),
        (Check::InPlaceLastUse, sealed(&last_use)),
        (Check::InPlacePosition, sealed(&position)),
        (Check::InPlaceOrder, sealed(&order)),
    ]
}

fn of_operators() -> Vec<(Check, Vec<u8>)> {
    let pool = |input: Shape, window: Window, output: Shape| {
        let mut sketch = Sketch::default();
        let x = sketch.input(input);
        let y = sketch.max_pool(x, window, output);
        sealed(&sketch.finish(y))
    };
    let mut groups = Sketch::default();
    let x = groups.input(Shape::map(2, 2, 4));
    // A third of four channels is one: all lengths agree.
    let y = groups.conv(x, window(1, 1), 3, 1, Shape::map(2, 2, 4));
    let mut work = Sketch::default();
    let map = work.input(Shape::map(8447, 8447, 1));
    let sums = work.conv(map, window(255, 1), 1, 1, Shape::map(8193, 8193, 4));
    vec![
        (
            Check::StepDilation,
            pool(Shape::map(5, 5, 1), Window { dilation_h: 2, dilation_w: 2, ..window(3, 1) }, Shape::map(1, 1, 1)),
        ),
        (
            Check::StepPadding,
            pool(Shape::map(1, 1, 1), Window { pad_top: 1, pad_left: 1, ..window(1, 2) }, Shape::map(1, 1, 1)),
        ),
        (Check::StepPadding, padded_average()),
        (Check::StepGroups, sealed(&groups.finish(y))),
        (Check::StepFactor, enlarged_by_a_fraction()),
        (Check::StepTokenPool, tokens_of_a_cut_map()),
        (Check::StepChannels, wide_norm()),
        (Check::StepTokens, long_attention()),
        (Check::StepElement, words_as_codes()),
        (Check::StepBox, boxed([2, 1, 1], 0)),
        (Check::StepBorder, boxed([1, 1, 1], 200)),
        (Check::StepBranches, branched(0, false)),
        (Check::StepResidual, branched(2, true)),
        (Check::StepPixels, wide_spatial_softmax()),
        (Check::Work, sealed(&work.finish(sums))),
    ]
}

fn padded_average() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let input = sketch.input(Shape::map(3, 3, 1));
    let output = sketch.tensor(ElementType::I8, Shape::map(2, 2, 1));
    let window = Window { pad_top: 1, pad_left: 1, ..window(2, 2) };
    let (requant, clamp) = (HALF, FULL);
    let pool = AveragePool { input, output, window, input_zero_point: 0, requant, zero_point: 0, clamp };
    sketch.steps.push(Step::AveragePool(pool));
    sealed(&sketch.finish(output))
}

fn enlarged_by_a_fraction() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let tensor = sketch.input(Shape::map(3, 3, 1));
    let output = sketch.tensor(ElementType::I8, Shape::map(4, 4, 1));
    let (rows, columns) = (sketch.constant(16), sketch.constant(16));
    let input = Term { tensor, zero_point: 0, multiplier: 1 };
    sketch.steps.push(Step::ResizeBilinear(ResizeBilinear {
        input,
        residual: None,
        output,
        rows,
        columns,
        weight_bits: 4,
        shift: 0,
        zero_point: 0,
        clamp: FULL,
    }));
    sealed(&sketch.finish(output))
}

/// Maps of three rows, pooled by two: the last row is lost.
fn tokens_of_a_cut_map() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let maps = [0; 2].map(|_| sketch.input(Shape::map(3, 2, 1)));
    let velocity = sketch.tensor(ElementType::I16, Shape::vector(1));
    sketch.inputs.push(velocity);
    let output = sketch.tensor(ElementType::I8, Shape::tokens(2, 1));
    let source = |map| TokenSource { map, zero_point: 0, pool_h: 2, pool_w: 2, multiplier: 1 };
    let (velocity_multipliers, position) = (sketch.constant(4), sketch.constant(4));
    sketch.steps.push(Step::Tokens(Tokens {
        first: source(maps[0]),
        second: source(maps[1]),
        velocity,
        output,
        velocity_multipliers,
        position,
        shift: 0,
        zero_point: 0,
        clamp: FULL,
    }));
    sealed(&sketch.finish(output))
}

fn wide_norm() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let input = sketch.input(Shape::vector(1025));
    let output = sketch.tensor(ElementType::I8, Shape::vector(1025));
    let (gains, offsets) = (sketch.constant(4 * 1025), sketch.constant(8 * 1025));
    sketch.steps.push(Step::LayerNorm(LayerNorm {
        input,
        output,
        first_row: 0,
        epsilon: 1,
        gains,
        offsets,
        shift: 0,
        zero_point: 0,
        clamp: FULL,
    }));
    sealed(&sketch.finish(output))
}

fn long_attention() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let shape = Shape::tokens(513, 1);
    let [query, key, value] = [0; 3].map(|_| sketch.input(shape));
    let output = sketch.tensor(ElementType::I8, shape);
    let (exp_table, scratch) = (sketch.constant(2 * 257), sketch.scratch(4 * 513 + 8));
    sketch.steps.push(Step::Attention(Attention {
        query,
        key,
        value,
        output,
        heads: 1,
        exponent: HALF,
        exp_table,
        requant: HALF,
        zero_point: 0,
        clamp: FULL,
        scratch,
    }));
    sealed(&sketch.finish(output))
}

/// One element in a border, from this place of a map of two rows.
fn boxed(begin: [u16; 3], border: i16) -> Vec<u8> {
    let mut sketch = Sketch::default();
    let input = sketch.input(Shape::map(2, 2, 2));
    let output = sketch.tensor(ElementType::I8, Shape::map(2, 2, 2));
    let (stride, size, before) = ([1; 3], [1; 3], [1; 3]);
    sketch.steps.push(Step::CopyBox(CopyBox { input, output, begin, stride, size, before, border }));
    sealed(&sketch.finish(output))
}

/// A linear layer of so many branches, with or without a second term.
fn branched(branches: u16, residual: bool) -> Vec<u8> {
    let mut sketch = Sketch::default();
    let (input, command) = (sketch.input(Shape::vector(4)), sketch.input(Shape::vector(1)));
    let output = sketch.tensor(ElementType::I8, Shape::vector(4));
    let weights = sketch.constant(16 * u32::from(branches));
    let residual = if residual { Residual::Stream { tensor: input } } else { Residual::None };
    let rescale = Rescale { residual, ..sketch.rescale(4 * branches) };
    let (kernel, scratch) = (KernelId::Direct, sketch.scratch(32));
    sketch.steps.push(Step::BranchLinear(BranchLinear {
        input,
        command,
        output,
        branches,
        kernel,
        weights,
        wide: false,
        rescale,
        scratch,
    }));
    sealed(&sketch.finish(output))
}

/// One row of logits, a pixel longer than can be summed.
fn wide_spatial_softmax() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let input = sketch.tensor(ElementType::I16, Shape::map(1, 257, 1));
    sketch.inputs.push(input);
    let output = sketch.tensor(ElementType::I32, Shape::tokens(1, 2));
    let exp_table = sketch.constant(2 * 257);
    sketch.steps.push(Step::SpatialSoftmax(SpatialSoftmax { input, output, exponent: HALF, exp_table }));
    sealed(&sketch.finish(output))
}

/// 32-bit words where the operator takes codes.
fn words_as_codes() -> Vec<u8> {
    let mut sketch = Sketch::default();
    let words = sketch.tensor(ElementType::I32, Shape::vector(4));
    sketch.inputs.push(words);
    let output = sketch.tensor(ElementType::I8, Shape::vector(4));
    sketch.requantize_to(words, output);
    sealed(&sketch.finish(output))
}

//! The messages of an event file: the parts of TensorFlow's `event.proto`, `summary.proto` and
//! `tensor.proto` that a training needs, with their field numbers. The only importer of `prost`.
//!
//! Written by hand: generated code would need `protoc` in every build. Decoders skip missing
//! fields.

pub use prost::Message;

/// `Event`: the contents of one record.
#[derive(Clone, PartialEq, Message)]
pub struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    pub wall_time: f64,
    /// Steps so far; at the start of a session its first step.
    #[prost(int64, tag = "2")]
    pub step: i64,
    /// The contents.
    #[prost(oneof = "EventContent", tags = "3, 5, 7")]
    pub what: Option<EventContent>,
}

/// `Event.what`
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum EventContent {
    /// First event of every file.
    #[prost(string, tag = "3")]
    FileVersion(String),
    /// Values of a step.
    #[prost(message, tag = "5")]
    Summary(EventSummary),
    /// Start of a session.
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

/// `SessionLog`
#[derive(Clone, PartialEq, Message)]
pub struct SessionLog {
    /// EventContent happens to the session.
    #[prost(enumeration = "SessionStatus", tag = "1")]
    pub status: i32,
}

/// `SessionLog.SessionStatus`
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, prost::Enumeration)]
#[repr(i32)]
pub enum SessionStatus {
    /// Required by the format.
    Unspecified = 0,
    /// Start of the session.
    Start = 1,
}

/// `Summary`
#[derive(Clone, PartialEq, Message)]
pub struct EventSummary {
    /// One value per tag.
    #[prost(message, repeated, tag = "1")]
    pub value: Vec<SummaryValue>,
}

/// `Summary.Value`
#[derive(Clone, PartialEq, Message)]
pub struct SummaryValue {
    /// Name of the series. Text before a slash groups series.
    #[prost(string, tag = "1")]
    pub tag: String,
    /// The plugin that shows a tensor; other kinds have none.
    #[prost(message, optional, tag = "9")]
    pub metadata: Option<SummaryMetadata>,
    /// The value.
    #[prost(oneof = "SummaryKind", tags = "2, 4, 8")]
    pub kind: Option<SummaryKind>,
}

/// `Summary.Value.value`
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum SummaryKind {
    /// A scalar.
    #[prost(float, tag = "2")]
    SimpleValue(f32),
    /// A picture.
    #[prost(message, tag = "4")]
    Image(EncodedImage),
    /// Text, as a tensor of one string.
    #[prost(message, tag = "8")]
    Tensor(StringTensor),
}

/// `Summary.Image`
#[derive(Clone, PartialEq, Message)]
pub struct EncodedImage {
    /// Height in pixels.
    #[prost(int32, tag = "1")]
    pub height: i32,
    /// Width in pixels.
    #[prost(int32, tag = "2")]
    pub width: i32,
    /// Number of channels: [`RGB`].
    #[prost(int32, tag = "3")]
    pub colorspace: i32,
    /// The PNG file.
    #[prost(bytes = "vec", tag = "4")]
    pub encoded_image_string: Vec<u8>,
}

/// [`EncodedImage::colorspace`] of three channels.
pub const RGB: i32 = 3;

/// `SummaryMetadata`
#[derive(Clone, PartialEq, Message)]
pub struct SummaryMetadata {
    /// The plugin of the series.
    #[prost(message, optional, tag = "1")]
    pub plugin_data: Option<PluginData>,
}

/// `SummaryMetadata.PluginData`, without `content`, which is empty for text.
#[derive(Clone, PartialEq, Message)]
pub struct PluginData {
    /// Name of the plugin.
    #[prost(string, tag = "1")]
    pub plugin_name: String,
}

/// `TensorProto` of strings.
#[derive(Clone, PartialEq, Message)]
pub struct StringTensor {
    /// Type of the elements: [`DT_STRING`].
    #[prost(int32, tag = "1")]
    pub dtype: i32,
    /// The shape.
    #[prost(message, optional, tag = "2")]
    pub tensor_shape: Option<TensorShape>,
    /// The elements.
    #[prost(bytes = "vec", repeated, tag = "8")]
    pub string_val: Vec<Vec<u8>>,
}

/// [`StringTensor::dtype`] of strings.
pub const DT_STRING: i32 = 7;

/// `TensorShapeProto` without dimensions: a single element.
#[derive(Clone, PartialEq, Message)]
pub struct TensorShape {}

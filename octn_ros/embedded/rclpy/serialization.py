from octn_ros.embedded import message


def serialize_message(msg):
    return message.serialize(msg)


def deserialize_message(data, message_type):
    return message.deserialize(data, message_type)

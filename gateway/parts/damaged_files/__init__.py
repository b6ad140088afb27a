"""Small files of the gateway that were damaged and moved aside: a fault until a person knows."""
